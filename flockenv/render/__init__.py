"""Pictures of snapshots, as pixels, PNG, GIF, HTML replay, or in a window.

Only `Window` opens a display. Pillow and pygame are imported when they are first needed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from flockenv.render.camera import turned
    from flockenv.render.gif import write_gif, write_png
    from flockenv.render.picture import draw
    from flockenv.render.replay import Group, Panel, write_replay
    from flockenv.render.window import Window

__all__ = ["Group", "Panel", "Window", "draw", "turned", "write_gif", "write_png", "write_replay"]

_MODULES: Final = {
    "Group": "replay",
    "Panel": "replay",
    "Window": "window",
    "draw": "picture",
    "turned": "camera",
    "write_gif": "gif",
    "write_png": "gif",
    "write_replay": "replay",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value  # the next look-up finds the name without this function
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
