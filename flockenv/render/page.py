"""Put the page of worlds together: one self-contained HTML file, of a recorded replay or of the live playground.

Its pieces are in the folder page/ beside this file: page.html, style sheets and scripts, each with a comment at its top
that says what it holds; a tab of the live page has a script of its name. The page loads nothing from elsewhere, and its
Content-Security-Policy allows only its own script and style, by their SHA-256.
"""

from __future__ import annotations

import html
import json
import re
from base64 import b64encode
from collections.abc import Mapping
from functools import lru_cache
from hashlib import sha256
from importlib.resources import files
from typing import Any, Final, Literal

from flockenv.render.palette import (
    ARROW,
    BODY_DISC,
    BOND,
    DART,
    DART_REACH,
    JUMP,
    METABALL,
    PAPER,
    POINT,
    ROLE_COLOURS,
    WAY,
)
from flockenv.render.quantise import BEYOND, DIRECTIONS

__all__ = ["page"]

Kind = Literal["recorded", "live"]

_SHARED: Final = ("base", "panels", "lens", "draw", "crowd", "metaballs", "faces", "pointer", "stage", "clock")
#: The scripts of a page, in order.
_SCRIPTS: Final[dict[str, tuple[str, ...]]] = {
    "recorded": (*_SHARED, "recorded"),
    "live": (
        *_SHARED, "socket", "overlay", "tools", "steering", "cursor", "controls", "rules", "values", "agent",
        "measures", "compare", "gallery", "share", "keys", "start",
    ),
}  # fmt: skip
_STYLES: Final[dict[str, tuple[str, ...]]] = {"recorded": ("style",), "live": ("style", "live")}
#: What a page may load besides its own script and style.
_SOURCES: Final = {"recorded": "", "live": "; connect-src 'self'; img-src 'self' blob:; media-src blob:"}


def page(kind: Kind, title: str, data: Mapping[str, Any]) -> bytes:
    """Return a page as UTF-8; data: what its script reads, as JSON, besides the palette; texts are never HTML."""
    style, script = (_joined(kind, suffix) for suffix in ("css", "js"))
    constants = {
        "roles": ROLE_COLOURS, "paper": PAPER, "dart": DART, "arrow": ARROW, "reach": DART_REACH, "disc": BODY_DISC,
        "bond": BOND, "point": POINT, "jump": JUMP, "way": WAY, "beyond": BEYOND, "directions": DIRECTIONS,
        "metaball": METABALL,
    }  # fmt: skip
    fills = {
        "TITLE": html.escape(title), "KIND": kind, "STYLE": style, "SCRIPT": script, "POLICY": policy(kind),
        "HEADER": _read("live_header.html") if kind == "live" else "",
        "SHEET": _read("live_sheet.html") if kind == "live" else "",
        "DATA": _to_script_json({"title": title, **data, **constants}),
    }  # fmt: skip
    # One pass, so that a title that contains a placeholder is not replaced again.
    text = re.sub(r"__([A-Z]+)__", lambda slot: fills[slot[1]], _read("page.html"))
    return text.encode("utf-8", "replace")


def policy(kind: Kind) -> str:
    """Return the Content-Security-Policy of a page."""
    style, script = (_hash(_joined(kind, suffix)) for suffix in ("css", "js"))
    own = f"default-src 'none'; style-src '{style}'; script-src '{script}'; base-uri 'none'; form-action 'none'"
    return own + _SOURCES[kind]


@lru_cache
def _joined(kind: Kind, suffix: str) -> str:
    """Return the style sheets or scripts of a page as one text."""
    names = (_STYLES if suffix == "css" else _SCRIPTS)[kind]
    return "\n" + "\n".join(_read(f"{name}.{suffix}") for name in names)


@lru_cache
def _read(name: str) -> str:
    return files("flockenv.render").joinpath("page", name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + b64encode(sha256(text.encode()).digest()).decode("ascii")


def _to_script_json(data: object) -> str:
    """Return JSON that is safe within a <script>: <, > and & are escaped."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
