"""A module of a package is available under its name: no function that the package exports hides it."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
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
    """Return the submodules whose name refers to another object in their package."""
    (folder,) = package.__path__
    paths = (path for pattern in ("[!_]*.py", "[!_]*/__init__.py") for path in Path(folder).glob(pattern))
    inside = (path.parent.name if path.name == "__init__.py" else path.stem for path in paths)
    return sorted(name for name in inside if not isinstance(getattr(package, name, package), ModuleType))


@pytest.mark.parametrize("name", PACKAGES)
def test_no_package_has_another_object_with_the_name_of_a_submodule(name: str) -> None:
    assert hidden(importlib.import_module(name)) == []


def test_a_function_with_the_name_of_its_module_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "hiding"
    package.mkdir()
    (package / "__init__.py").write_text("from hiding.edge import edge\nimport hiding.open\n")
    (package / "edge.py").write_text("def edge(): ...\n")
    (package / "open.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    assert hidden(importlib.import_module("hiding")) == ["edge"]


PATH = re.compile(
    r"(?<![\w/.])((?:flockenv|agents|benchmarks|configs|docs|tests)(?:/\w+)+\.(?:py|md|yaml|json|png|html))\b"
)
MODULE = re.compile(r"`flockenv((?:\.[a-z_]\w*)+)")
MADE_UP = {"configs/no.yaml", "flockenv/helpers.py"}
"""Paths of files that must not exist, for tests."""


def texts() -> Iterator[Path]:
    for folder, suffixes in (("flockenv", ".py"), ("agents", ".py"), ("benchmarks", ".py"), ("tests", ".py")):
        yield from sorted((ROOT / folder).rglob(f"*{suffixes}"))
    yield from [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "configs").rglob("*.yaml"),
    ]


def test_files_and_modules_named_in_texts_exist() -> None:
    missing = []
    for path in texts():
        text = path.read_text(encoding="utf-8")
        named = {name for name in PATH.findall(text) if not re.search(r"/[A-Z]+\.", name)} - MADE_UP
        missing += [f"{path.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).exists()]
        for name in MODULE.findall(text):
            package, *rest = name.strip(".").split(".")
            folder = ROOT / "flockenv" / package
            known = folder.is_dir() and (not rest or (folder / rest[0]).is_dir() or (folder / f"{rest[0]}.py").exists())
            exported = folder.is_dir() and rest and rest[0] in (folder / "__init__.py").read_text(encoding="utf-8")
            if not (known or exported):
                missing.append(f"{path.relative_to(ROOT)}: flockenv{name}")
    assert missing == []
