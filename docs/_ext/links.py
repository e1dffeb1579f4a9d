"""Links of pages to files outside docs/: to copies of the Markdown pages of the root, to pages of scenes, to downloads.

The pages stay as they are on a code host, where these links work without change.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

__all__ = ["LINK", "copied_pages", "rewrite_source"]

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)(?=[#)\s])")
"""The path in a Markdown link or picture, if it is no address and no anchor alone."""

COPIED = {
    "CONTRIBUTING.md": "contributing", "CODE_OF_CONDUCT.md": "code_of_conduct", "SECURITY.md": "security",
    "CHANGELOG.md": "changelog",
}  # fmt: skip
"""Pages of the root that the site shows, and their names in docs/generated/."""

FOLDERS = {"configs/scenes": "scenes", "configs/crowds": "crowd_scenes"}
"""Folders that have a generated page."""


def copied_pages(docs: Path) -> dict[str, str]:
    """Return the pages of the root that the site shows; their links start from docs/generated/."""
    root, made = docs.parent, docs / "generated"
    return {
        name: LINK.sub(lambda match: _moved(root / match[1], made, docs), (root / file).read_text(encoding="utf-8"))
        for file, name in COPIED.items()
    }


def rewrite_source(app: Sphinx, docname: str, source: list[str]) -> None:
    """Replace links to pages of the root and to folders by links to generated pages."""
    docs = Path(app.srcdir)
    folder = (docs / docname).parent
    source[0] = LINK.sub(lambda match: _moved(folder / match[1], folder, docs, match[1]), source[0])


def _moved(target: Path, folder: Path, docs: Path, unchanged: str | None = None) -> str:
    """Return the link to a file or folder from a page in `folder`; `unchanged` if the site has it in its place."""
    inside = os.path.relpath(target, docs.parent).replace(os.sep, "/")
    name = COPIED.get(inside) or FOLDERS.get(inside.rstrip("/"))
    if name is not None:
        return os.path.relpath(docs / "generated" / f"{name}.md", folder)
    return unchanged or os.path.relpath(target, folder)
