"""The public API: docs/api.md names its modules, tests/public_api.txt its names with their parameters.

If a change is intended, `python -m tests.test_public_api` writes the list anew; tell users in CHANGELOG.md.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import flockenv
from docs._ext.public_api import description, internal_modules, lines, public_modules

LIST = Path(__file__).with_name("public_api.txt")


def test_the_public_api_is_that_of_the_list() -> None:
    """If this fails, see the docstring of this file."""
    listed, found = LIST.read_text(encoding="utf-8").splitlines(), list(lines())
    assert {"gone": sorted({*listed} - {*found}), "new": sorted({*found} - {*listed})} == {"gone": [], "new": []}
    assert found == listed


def test_every_package_is_public_or_internal() -> None:
    """A package without names of its own may have public modules; its others are then internal, as the page says."""
    public, internal = public_modules(), internal_modules()
    packages = [each.name for each in pkgutil.walk_packages(flockenv.__path__, "flockenv.") if each.ispkg]
    assert {*packages} >= {"flockenv.scene", "flockenv.engine"}
    for name in packages:
        inside = any(name == each or name.startswith(f"{each}.") for each in internal)
        parts = any(each.startswith(f"{name}.") for each in public)
        has_names = bool(getattr(importlib.import_module(name), "__all__", ()))
        assert (name in public) != inside or (parts and not has_names), f"{name}: docs/api.md does not list it"


def test_every_public_name_has_a_description() -> None:
    """A docstring; of a constant or type alias, the text below its assignment."""
    names = [(module, name) for module in public_modules() for name in importlib.import_module(module).__all__]
    assert [f"{module}.{name}" for module, name in names if not description(module, name)] == []
    assert description("flockenv.evaluation", "TUNING").startswith("First world seeds")  # assigned beside another name
    assert description("flockenv.scene", "AnyEffect").startswith("An effect")  # under `else`


if __name__ == "__main__":
    LIST.write_text("".join(f"{line}\n" for line in lines()), encoding="utf-8")
