"""Sphinx extension: write the pages about what the registries of flockenv contain, and prepare docstrings and links.

Pages are written into docs/generated/, which is not committed. A page that has not changed is not written again, so
that a second build reads only what is new; pages of kinds that are gone are removed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import api_pages
import docstrings
import environment_pages
import films
import kind_pages
import links
import pictures
import scene_pages

if TYPE_CHECKING:
    from sphinx.application import Sphinx

__all__ = ["setup", "write_pages"]


def write_pages(docs: Path, films_are_drawn: bool) -> None:
    """Write all generated pages below docs/generated/ and remove those that no longer belong there."""
    made = docs / "generated"
    pages = {
        **environment_pages.pages(docs, films_are_drawn),
        **kind_pages.pages(docs),
        **scene_pages.pages(docs),
        **api_pages.pages(docs),
        **links.copied_pages(docs),
    }
    for old in made.glob("**/*.md"):
        if str(old.relative_to(made).with_suffix("")) not in pages:
            old.unlink()
    for name, text in pages.items():
        path = made / f"{name}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _begin(app: Sphinx) -> None:
    docs = Path(app.srcdir)
    if app.config.films:
        films.draw_missing(docs / "generated" / "films")
    pictures.draw_missing(docs / "generated" / "pictures")
    write_pages(docs, app.config.films)


def _leave_out_source(app: Sphinx, pagename: str, template: str, context: dict[str, Any], tree: object) -> None:
    """Leave out the links of the theme to the source of a generated page, which is not in the repository."""
    if pagename.startswith("generated/"):
        context["page_source_suffix"] = ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension; `-D films=0` leaves out the films of tasks, which take a minute or two to draw."""
    app.add_config_value("films", True, "")
    app.connect("builder-inited", _begin)
    app.connect("env-updated", api_pages.mark_second_names)
    app.connect("html-page-context", _leave_out_source)
    app.connect("source-read", links.rewrite_source)
    app.connect("autodoc-process-docstring", docstrings.process, priority=400)  # before napoleon reads Args:
    app.connect("autodoc-process-signature", docstrings.signature)
    app.connect("autodoc-skip-member", docstrings.skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
