"""A module of a package can be reached by its name: no function that the package exports hides it."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = sorted(
    ".".join(path.parent.relative_to(ROOT).parts)
    for top in ("flockenv", "agents", "benchmarks")
    for path in (ROOT / top).rglob("__init__.py")
)


def hidden(package: ModuleType) -> list[str]:
    """Return the submodules whose name is something else in their package."""
    (folder,) = package.__path__
    paths = (path for pattern in ("[!_]*.py", "[!_]*/__init__.py") for path in Path(folder).glob(pattern))
    inside = (path.parent.name if path.name == "__init__.py" else path.stem for path in paths)
    return sorted(name for name in inside if not isinstance(getattr(package, name, package), ModuleType))


@pytest.mark.parametrize("name", PACKAGES)
def test_no_package_has_another_thing_by_the_name_of_a_submodule(name: str) -> None:
    assert hidden(importlib.import_module(name)) == []


def test_a_function_by_the_name_of_its_module_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "hiding"
    package.mkdir()
    (package / "__init__.py").write_text("from hiding.edge import edge\nimport hiding.open\n")
    (package / "edge.py").write_text("def edge(): ...\n")
    (package / "open.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    assert hidden(importlib.import_module("hiding")) == ["edge"]
