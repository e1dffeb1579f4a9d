"""write_replay(): one HTML file that plays the same world under several players, side by side, and needs nothing else.

The page is replay.html beside this file. Its data is one JSON object in which the numbers per frame are base64 of
little-endian arrays: positions uint16 over the shown region widened by half of itself on each side, headings uint8.
24 agents take 160 bytes a frame.
"""

from __future__ import annotations

import html
import json
import math
import os
import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import replace_file
from flockenv.model.appearance import Appearance
from flockenv.model.snapshot import Floats, Mark, Snapshot
from flockenv.render.palette import ARROW, BODY_DISC, BOND, DART, DART_REACH, JUMP, PAPER, POINT, ROLE_COLOURS, WAY

__all__ = ["Group", "Panel", "write_replay"]

#: Bytes that stand for no direction; the directions are 0..253, counter-clockwise from +x.
_DIRECTIONS: Final = 254
_RESTING: Final = 254
_ABSENT: Final = 255
#: The packed region: [low, high] and this share of its extent beyond it on each side; what is further out stays there.
_BEYOND: Final = 0.5
_LEVELS: Final = 65535
#: Places of a look's range whose colours are written.
_LOOKS: Final = 16


@dataclass(frozen=True, eq=False)
class Panel:
    """The episode of one player: a picture of the replay.

    player: its name. snapshots: one per frame, times strictly increasing, the same agents, obstacles may move.
    reward: the return accumulated up to each snapshot; None where nothing is paid, then no return is shown.
    outcome: the text shown at its end, "captured at 6.2 s".
    Raises ValueError or TypeError, in one line that names the player, on anything else.
    """

    player: str
    snapshots: Sequence[Snapshot]
    reward: Sequence[float] | None
    outcome: str

    def __post_init__(self) -> None:
        for name in ("player", "outcome"):
            if not isinstance(getattr(self, name), str):
                raise TypeError(f"Panel.{name}: must be a str, got {type(getattr(self, name)).__name__}")
        object.__setattr__(self, "snapshots", tuple(self.snapshots))
        shots, who = self.snapshots, f"panel {self.player!r}"
        if not shots:
            raise ValueError(f"{who}: must have at least one snapshot, got none")
        if self.reward is not None:
            object.__setattr__(self, "reward", _returns(who, self.reward, len(shots)))
        for k, (shot, last) in enumerate(zip(shots[1:], shots[:-1], strict=True), 1):
            if shot.time <= last.time:
                raise ValueError(
                    f"{who}: times must increase, got {last.time:g} s then {shot.time:g} s at snapshot {k}"
                )
            if not _alike(shot, shots[0]):
                raise ValueError(f"{who}: snapshot {k} must have the agents, roles, bonds and region of snapshot 0")


def _returns(panel: str, reward: Sequence[float], shots: int) -> tuple[float, ...]:
    """Return the rewards of a panel as floats; ValueError unless there is a finite one per snapshot."""
    found = tuple(float(r) for r in reward)
    if len(found) != shots:
        raise ValueError(f"{panel}: must have one reward per snapshot ({shots}), got {len(found)}")
    if not all(map(math.isfinite, found)):
        raise ValueError(f"{panel}: rewards must be finite, got {next(r for r in found if not math.isfinite(r))}")
    return found


@dataclass(frozen=True, eq=False)
class Group:
    """One task: a title and the panels that are played side by side, in lockstep."""

    title: str
    panels: Sequence[Panel]

    def __post_init__(self) -> None:
        object.__setattr__(self, "panels", tuple(self.panels))
        if not self.panels:
            raise ValueError(f"group {self.title!r}: must have at least one panel, got none")


def write_replay(path: str | os.PathLike[str], groups: Sequence[Group], title: str) -> None:
    """Write the replay of one or several tasks as one self-contained HTML file; it appears whole or not at all.

    The page loads nothing, which its Content-Security-Policy also forbids; names are always shown as text.
    Its address takes #task=1, t=4.2 (s) and play or pause, joined by &. Raises ValueError if there is no group.
    """
    if not groups:
        raise ValueError("groups: there must be at least one, got none")
    data = {
        "title": title,
        "groups": [{"title": group.title, "panels": [_panel(panel) for panel in group.panels]} for group in groups],
        "roles": ROLE_COLOURS,
        "paper": PAPER,
        "dart": DART,
        "arrow": ARROW,
        "reach": DART_REACH,
        "disc": BODY_DISC,
        "bond": BOND,
        "point": POINT,
        "jump": JUMP,
        "way": WAY,
        "beyond": _BEYOND,
        "directions": _DIRECTIONS,
    }
    fills = {"TITLE": html.escape(title), "DATA": _embed(data)}
    page = files("flockenv.render").joinpath("replay.html").read_text(encoding="utf-8")
    # One pass: a title that reads like a slot is not filled in again.
    page = re.sub(r"__(TITLE|DATA)__", lambda slot: fills[slot[1]], page)
    with replace_file(path) as file:
        file.write(page.encode("utf-8", "replace"))


def _embed(data: object) -> str:
    """Return JSON that no HTML parser can leave: <, > and & only as escapes."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _alike(one: Snapshot, other: Snapshot) -> bool:
    return (
        one.pos.shape == other.pos.shape
        and one.roles == other.roles
        and one.periodic == other.periodic
        and np.array_equal(one.bonds, other.bonds)
        and one.looks == other.looks
        and np.array_equal(np.asarray(one.look), np.asarray(other.look))
        and np.array_equal(one.low, other.low)
        and np.array_equal(one.high, other.high)
    )


def _panel(panel: Panel) -> dict[str, Any]:
    shots = panel.snapshots
    first = shots[0]
    return {
        "player": panel.player,
        "outcome": panel.outcome,
        "time": [_short(shot.time, 9) for shot in shots],
        "reward": None if panel.reward is None else [_short(r, 6) for r in panel.reward],
        "low": first.low.tolist(),
        "high": first.high.tolist(),
        "periodic": first.periodic,
        "roles": first.roles,
        "radius": [_short(r, 6) for r in first.radius],
        "pos": _packed(np.stack([_positions(shot) for shot in shots])),
        "heading": _packed(np.stack([_headings(shot) for shot in shots])),
        "bonds": first.bonds.tolist(),
        "scenery": _scenery(shots),
        **_dress(shots),
    }


def _dress(shots: Sequence[Snapshot]) -> dict[str, Any]:
    """Return looks, the look of each agent, and per frame shades 0..255 and new agents; no key without any."""
    first, found = shots[0], dict[str, Any]()
    if first.looks:
        found["looks"] = [_look(look) for look in first.looks]
        found["look"] = np.asarray(first.look).tolist()
        found["shade"] = _packed(np.stack([np.rint(255 * shot.shade).astype(np.uint8) for shot in shots]))
    if first.identity is not None:
        before = [first, *shots[:-1]]
        fresh = [~old.is_same(new) for old, new in zip(before, shots, strict=True)]
        found["fresh"] = _packed(np.stack(fresh).astype(np.uint8))
    return found


def _look(look: Appearance) -> dict[str, Any]:
    """Return a look with its colours, opacities and sizes at LOOKS places of its range."""
    places = np.linspace(0.0, 1.0, _LOOKS).tolist()
    colours = ["#{:02x}{:02x}{:02x}".format(*look.colour(s, "#000000")) for s in places] if look.colours else None
    return {
        "form": look.form,
        "vertices": look.vertices,
        "trail": look.trail,
        "colours": colours,
        "opacity": [_short(look.opacity_at(s), 3) for s in places],
        "size": None if look.size is None else [_short(look.size_at(s, 0.0), 4) for s in places],
    }


def _short(value: float, digits: int) -> float:
    """Return the number rounded to the significant digits that are written."""
    return float(f"{value:.{digits}g}")


def _packed(array: NDArray[np.uint8] | NDArray[np.uint16]) -> str:
    return b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode("ascii")


def _positions(shot: Snapshot) -> NDArray[np.uint16]:
    extent = shot.high - shot.low
    low = shot.low - _BEYOND * extent
    high = shot.high + _BEYOND * extent
    pos: Floats = np.where(shot.visible[:, None], shot.pos, low)
    level = (np.clip(pos, low, high) - low) / (high - low) * _LEVELS
    return np.rint(level).astype(np.uint16)


def _headings(shot: Snapshot) -> NDArray[np.uint8]:
    """Return the directions of agents in x and y, (N,) uint8; _RESTING or _ABSENT for the others."""
    vel = np.where(shot.visible[:, None], shot.aim, 0.0)[:, :2]
    turn = np.arctan2(vel[:, 1], vel[:, 0]) / (2.0 * np.pi)
    heading = np.rint(turn * _DIRECTIONS).astype(np.int64) % _DIRECTIONS
    heading[~vel.any(axis=1)] = _RESTING
    heading[~(shot.alive & shot.visible)] = _ABSENT
    return heading.astype(np.uint8)


def _scenery(shots: Sequence[Snapshot]) -> list[dict[str, Any]]:
    """Return the obstacles and marks, with the frame from which each set holds, once per change."""
    scenes: list[dict[str, Any]] = []
    told: dict[Mark, dict[str, Any]] = {}  # by the mark: one that stays is converted once
    for k, shot in enumerate(shots):
        stones = np.column_stack([shot.obstacle_centre[:, :2], shot.obstacle_radius]).tolist()
        scene = {
            "stones": [[_short(x, 6) for x in stone] for stone in stones],
            "walls": [[[_short(x, 6) for x in corner] for corner in wall.tolist()] for wall in shot.outlines],
            "marks": [told.get(mark) or told.setdefault(mark, _mark(mark)) for mark in shot.marks],
        }
        if not scenes or scene != {name: scenes[-1][name] for name in scene}:
            scenes.append({"from": k, **scene})
    return scenes


def _mark(mark: Mark) -> dict[str, Any]:
    norm = float(np.linalg.norm(mark.vector)) or 1.0
    return {
        "kind": mark.kind,
        "at": [_short(x, 6) for x in mark.at[:2]],
        "vector": [_short(x, 6) for x in mark.vector[:2] / norm],
        "radius": _short(mark.radius, 6),
    }
