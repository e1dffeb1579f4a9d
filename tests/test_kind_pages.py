"""Pages of behaviours, effects, methods, constraints and presets: each has a picture, a formula, a source, limits."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from flockenv.behaviours import BEHAVIOURS
from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene.presets import PRESETS
from tests import catalogue
from tests.page_scripts import ROOT

DOCS = ROOT / "docs"
SOURCE = re.compile(r"\b(1[67]|18|19|20)\d\d\b|\bours\b")
FORMULA = re.compile(r"\S (=|&lt;=|>=) \S|\bmap\b")


def section(page: str, title: str) -> str:
    """Return the text of the only section of this title."""
    (found,) = re.findall(rf"^## {title}$(.*?)(?=^## |^Class `|^It has no fields|\Z)", page, re.M | re.S)
    return str(found).strip()


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
        name: re.split(r"^(?:## (?:Limits|Fields|Properties|Values|Used by)|Class `)", text, flags=re.M)[0]
        for name, text in pages.items()
    }
    assert [name for name, text in before.items() if not SOURCE.search(text)] == []
    assert [name for name, text in before.items() if not FORMULA.search(text)] == []


def test_a_preset_has_a_formula_for_each_of_its_effects(pages: dict[str, str]) -> None:
    for name, model in PRESETS.items():
        rows = section(pages[f"presets/{name}"], "Formulas").splitlines()[2:]
        kinds = [each.kind for each in (*model.behaviours(False, None), *model.bodies)]
        assert [re.findall(r"\[(\w+)\]\(.* F = ", row) for row in rows] == [[kind] for kind in kinds]


def test_every_page_has_limits(pages: dict[str, str]) -> None:
    """Besides the facts of its class, or for a preset the limits of its effects, there is a sentence of its own."""
    found = {name: section(text, "Limits") for name, text in pages.items()}
    presets = {name for name in pages if name.startswith("presets/")}
    assert [
        name
        for name in presets
        if found[name].count("](../") < 3 or " is stable for these pedestrians " not in found[name]
    ] == []
    own = {name: re.sub(r"^\*.*\n?", "", found[name], flags=re.M) for name in pages.keys() - presets}
    own |= {name: own[name].partition("\n\n")[2] for name in own if name.startswith("methods/")}  # after the steps
    assert [name for name, text in own.items() if not re.match(r"[A-Z].{15,}\.$", text.strip(), re.S)] == []


def test_dimensions_in_the_limits_are_those_of_the_catalogue(pages: dict[str, str]) -> None:
    tried: dict[str, set[int]] = {}
    for row in catalogue.EFFECTS:
        tried.setdefault(row.effect.kind, set()).update(row.dimensions)
    shown = {}
    for kind in tried:
        text = section(pages[f"{'behaviours' if kind in BEHAVIOURS else 'effects'}/{kind}"], "Limits")
        shown[kind] = {int(d) for d in re.search(r"^\* In (2-D and 3|2|3)-D", text, re.M)[1].split("-D and ")}  # type: ignore[index]
    assert {kind for kind in tried if shown[kind] != tried[kind]} == {"way"}  # its row has a target in the plane


def test_every_field_has_a_meaning(pages: dict[str, str]) -> None:
    rows = {name: section(text, "Fields").splitlines()[2:] for name, text in pages.items() if "## Fields" in text}
    assert sum(map(len, rows.values())) > 500
    assert [f"{name}: {row}" for name in rows for row in rows[name] if not row.rsplit(" | ", 1)[1].strip(" |")] == []


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
    assert text in section(pages[f"methods/{kind}"], "Limits")
