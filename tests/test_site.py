"""The site: links of its pages and of README resolve, and `python -m sphinx -W` builds it."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from docs._ext.links import COPIED
from docs._ext.public_api import lines
from tests.page_scripts import ROOT

PAGES = sorted(
    path
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))
    if not {"generated", "_build"} & {*path.relative_to(ROOT).parts}
)
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
TARGET = re.compile(r"\]\((?![a-z]+:)([^)\s]+)[^)]*\)|<img src=\"(?![a-z]+:)([^\"]+)\"")


def text_of(path: Path) -> str:
    """Return a page without its blocks of code."""
    return FENCED.sub("", path.read_text(encoding="utf-8"))


def anchors_of(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as code hosts and the site make them."""
    headings = re.findall(r"^#+ +(.*?) *$", text_of(path), re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)|`", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading(path: Path) -> None:
    for linked, shown in TARGET.findall(text_of(path)):
        name, _, anchor = (linked or shown).partition("#")
        target = (path.parent / name).resolve() if name else path
        assert target.exists(), f"{name}: no such file"
        assert not anchor or anchor in anchors_of(target), f"{name}: has no heading #{anchor}"


def test_pages_with_links_were_found() -> None:
    assert {"README.md", "docs/index.md", "docs/history/players.md"} <= {str(p.relative_to(ROOT)) for p in PAGES}
    assert sum(len(TARGET.findall(text_of(path))) for path in PAGES) > 200
    assert {"seeds", "where-to-go-next"} <= anchors_of(ROOT / "docs/players.md") | anchors_of(ROOT / "README.md")


def test_every_page_is_on_the_site() -> None:
    """Named in a toctree of docs/index.md; pages of the root that others link to are copied by docs/_ext/links.py."""
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^(?:[^<\n]*<)?([\w/]+)>?$", index, re.MULTILINE))
    pages = {str(path.relative_to(ROOT / "docs").with_suffix("")) for path in PAGES if path.parent != ROOT}
    assert pages - listed == {"index"}
    assert {f"generated/{name}" for name in COPIED.values()} <= listed
    for path in PAGES:
        linked = {(path.parent / name.partition("#")[0]).resolve() for name, _ in TARGET.findall(text_of(path))}
        roots = {
            each.name for each in linked if each.suffix == ".md" and each.parent == ROOT and path.name != "README.md"
        }
        assert roots <= {*COPIED}, f"{path.name}: links to a page that the site does not have"


def names_in(inventory: Path) -> set[str]:
    """Return the names that a site documents: four lines, then compressed lines of a name and where it is."""
    return {
        line.split()[0] for line in zlib.decompress(inventory.read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    }


@pytest.fixture(scope="module")
def site() -> Path:
    """The site, built into the folder of the stage `site` of .ci/run: only what is new, without the films of tasks."""
    if any(importlib.util.find_spec(name) is None for name in ("sphinx", "myst_parser", "furo")):
        pytest.skip("needs sphinx, myst-parser and furo: pip install 'flockenv[docs]'")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-D", "films=0", "-b", "html", "docs"]
    built = ROOT / "docs" / "_build" / "html"
    done = subprocess.run([*command, str(built)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return built


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_refers_to_no_other_host(site: Path) -> None:
    assert {line.split("(")[0].split(":")[0] for line in lines()} - names_in(site / "objects.inv") == set()
    loaded = re.compile(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"(?:https?:)?//[^\"]*\"")
    for path in site.rglob("*.html"):
        assert loaded.findall(path.read_text(encoding="utf-8")) == [], path.name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "hit"), [("separation", "generated/behaviours/separation"), ("load_player", "flockenv.players")]
)
def test_the_search_page_finds_a_word_without_a_network(site: Path, word: str, hit: str) -> None:
    """As files of a disk, in a browser that is offline."""
    pytest.importorskip("websockets", reason="needs the extra `play`: pip install 'flockenv[play]'")
    from tests.playground import Visit, browsing, wait_for

    with browsing() as chromium:
        here = Visit(chromium, f"{(site / 'search.html').as_uri()}?q={word}", offline=True)
        links = here.page.locator("#search-results li a")
        wait_for(lambda: links.count() > 0)
        found = [link.get_attribute("href") or "" for link in links.all()]
        assert any(hit in each for each in found), found
        links.first.click()
        assert here.page.url.startswith(site.as_uri()) and "search.html" not in here.page.url
        assert [url for url in here.requests if not url.startswith("file:")] == []
        here.close()
