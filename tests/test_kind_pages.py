"""Pages of behaviours, effects, methods, constraints and presets: each has a picture, a formula, a source, limits."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene.presets import PRESETS
from tests.page_scripts import ROOT

DOCS = ROOT / "docs"
SOURCE = re.compile(r"\b(1[67]|18|19|20)\d\d\b|\bours\b")
FORMULA = re.compile(r"\S (=|&lt;=|>=) \S|\bmap\b")


@pytest.fixture(scope="module")
def pages() -> Iterator[dict[str, str]]:
    """Return the pages, as the extension of the site makes them: its modules import each other by bare names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS / "_ext"))
        import kind_pages

        yield {name: text for name, text in kind_pages.pages(DOCS).items() if not name.endswith("/index")}


def test_every_page_has_a_source_and_a_formula(pages: dict[str, str]) -> None:
    assert {"behaviours/seek", "effects/drag", "methods/rk4", "constraints/rods", "presets/moussaid_2009"} <= {*pages}
    before = {
        name: re.split(r"^(?:## (?:Fields|Properties|Used by)|Class `)", text, flags=re.M)[0]
        for name, text in pages.items()
    }
    assert [name for name, text in before.items() if not SOURCE.search(text)] == []
    presets = {name for name in pages if name.startswith("presets/")}  # they stand for effects, which have formulas
    assert [name for name, text in before.items() if not FORMULA.search(text) and name not in presets] == []


def test_every_page_has_a_picture_that_exists_or_is_drawn_when_the_site_is_built(pages: dict[str, str]) -> None:
    import pictures  # from docs/_ext, see the fixture

    drawn = {*pictures.demos(), *INTEGRATORS}
    for name, text in pages.items():
        shown = re.search(r"!\[[^]]*\]\(([^)]+)\)", text)
        assert shown, f"{name}: has no picture"
        path = (DOCS / "generated" / name).parent / shown[1]
        found = path.stem in drawn if shown[1].startswith("../pictures/") else path.resolve().is_file()
        assert found, f"{name}: no picture {shown[1]}"
    assert {*PRESETS} <= drawn


@pytest.mark.parametrize(
    ("kind", "text"),
    [("rk4", "h omega < 2.83"), ("explicit_euler", "unstable at any step"), ("implicit_euler", "stable at any step")],
)
def test_methods_have_their_limits(pages: dict[str, str], kind: str, text: str) -> None:
    """The limit of RK4 on the imaginary axis is sqrt 8."""
    assert text in pages[f"methods/{kind}"].split("## Limits")[1]
