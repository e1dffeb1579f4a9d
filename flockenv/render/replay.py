"""Write a replay: a self-contained HTML file that plays the same world under several players, side by side.

The page is put together in page.py; its data is one JSON object. Numbers of each frame are little-endian arrays in
base64, as quantise.py defines them. A frame of 24 agents takes 160 bytes.
"""

from __future__ import annotations

import math
import os
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import replace_file
from flockenv.model.appearance import Appearance
from flockenv.model.snapshot import Mark, Snapshot
from flockenv.render.page import page
from flockenv.render.quantise import quantise_headings, quantise_positions

__all__ = ["Group", "Panel", "look_data", "replay_page", "round_digits", "scenery_data", "write_replay"]

#: Number of points of an appearance's range at which its colours are stored.
_LOOKS: Final = 16


@dataclass(frozen=True, eq=False)
class Panel:
    """The episode of one player, one of the pictures side by side.

    player: its name. snapshots: one per frame, of the same agents, with increasing times; obstacles may move.
    reward: the return up to each snapshot; None: no return is shown. outcome: text at the end, "captured at 6.2 s".
    Raises ValueError or TypeError for anything else, in one line that names the player.
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
        shots, panel = self.snapshots, f"panel {self.player!r}"
        if not shots:
            raise ValueError(f"{panel}: must have at least one snapshot, got none")
        if self.reward is not None:
            object.__setattr__(self, "reward", _check_rewards(panel, self.reward, len(shots)))
        for k, (shot, previous) in enumerate(zip(shots[1:], shots[:-1], strict=True), 1):
            if shot.time <= previous.time:
                raise ValueError(
                    f"{panel}: times must increase, got {previous.time:g} s then {shot.time:g} s at snapshot {k}"
                )
            if not _show_same_agents(shot, shots[0]):
                raise ValueError(f"{panel}: snapshot {k} must have the agents, roles, bonds and region of snapshot 0")


def _check_rewards(panel: str, reward: Sequence[float], shots: int) -> tuple[float, ...]:
    """Return the rewards of a panel as floats; ValueError unless there is one finite number per snapshot."""
    rewards = tuple(float(r) for r in reward)
    if len(rewards) != shots:
        raise ValueError(f"{panel}: must have one reward per snapshot ({shots}), got {len(rewards)}")
    if not all(map(math.isfinite, rewards)):
        raise ValueError(f"{panel}: rewards must be finite, got {next(r for r in rewards if not math.isfinite(r))}")
    return rewards


@dataclass(frozen=True, eq=False)
class Group:
    """One task: a title, and panels that are played side by side at the same time."""

    title: str
    panels: Sequence[Panel]

    def __post_init__(self) -> None:
        object.__setattr__(self, "panels", tuple(self.panels))
        if not self.panels:
            raise ValueError(f"group {self.title!r}: must have at least one panel, got none")


def write_replay(path: str | os.PathLike[str], groups: Sequence[Group], title: str) -> None:
    """Write the replay of one or several tasks as one self-contained HTML file, completely or not at all.

    path: of the file; groups: the recorded episodes of each task; title: of the page.

    The page loads nothing, and its Content-Security-Policy forbids it; names are shown as text, never as HTML.
    Its address may end with #task=1&t=4.2&play: the task, the time, s, and play or pause. Raises ValueError if there is
    no group.
    """
    text = replay_page(groups, title)
    with replace_file(path) as file:
        file.write(text)


def replay_page(groups: Sequence[Group], title: str) -> bytes:
    """Return the replay that `write_replay` writes."""
    if not groups:
        raise ValueError("groups: there must be at least one, got none")
    shown = [{"title": group.title, "panels": [*map(_panel_data, group.panels)]} for group in groups]
    return page("recorded", title, {"groups": shown})


def _show_same_agents(one: Snapshot, other: Snapshot) -> bool:
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


def _panel_data(panel: Panel) -> dict[str, Any]:
    shots = panel.snapshots
    first = shots[0]
    return {
        "player": panel.player,
        "outcome": panel.outcome,
        "time": [round_digits(shot.time, 9) for shot in shots],
        "reward": None if panel.reward is None else [round_digits(r, 6) for r in panel.reward],
        "low": first.low.tolist(),
        "high": first.high.tolist(),
        "periodic": first.periodic,
        "roles": first.roles,
        "radius": [round_digits(r, 6) for r in first.radius],
        "pos": _to_base64(np.stack([_quantise_positions(shot) for shot in shots])),
        "heading": _to_base64(np.stack([_quantise_headings(shot) for shot in shots])),
        "bonds": first.bonds.tolist(),
        "faces": first.faces.tolist(),
        "covered": np.asarray(first.covered).astype(int).tolist() if len(first.faces) else [],
        **_broken_data(shots),
        "scenery": _scenery_data(shots),
        **_look_data(shots),
    }


def _broken_data(shots: Sequence[Snapshot]) -> dict[str, Any]:
    """Return for each bond the first frame in which it is broken, -1 for never; {} if none ever is."""
    if shots[-1].broken is None or not shots[-1].broken.any():
        return {}
    broken = np.stack([np.zeros(len(shots[0].bonds), bool) if s.broken is None else s.broken for s in shots])
    return {"gone": np.where(broken.any(axis=0), broken.argmax(axis=0), -1).tolist()}


def _look_data(shots: Sequence[Snapshot]) -> dict[str, Any]:
    """Return the appearances, that of each agent, and per frame shades (0 to 255) and new agents; {} without any."""
    first, data = shots[0], dict[str, Any]()
    if first.looks:
        data["looks"] = [look_data(look) for look in first.looks]
        data["look"] = np.asarray(first.look).tolist()
        data["shade"] = _to_base64(np.stack([np.rint(255 * shot.shade).astype(np.uint8) for shot in shots]))
    if first.identity is not None:
        before = [first, *shots[:-1]]
        fresh = [~previous.is_same(after) for previous, after in zip(before, shots, strict=True)]
        data["fresh"] = _to_base64(np.stack(fresh).astype(np.uint8))
    return data


def look_data(look: Appearance) -> dict[str, Any]:
    """Return an appearance with its colours, opacities and sizes at _LOOKS points of its range."""
    places = np.linspace(0.0, 1.0, _LOOKS).tolist()
    colours = ["#{:02x}{:02x}{:02x}".format(*look.colour(s, "#000000")) for s in places] if look.colours else None
    return {
        "form": look.form,
        "vertices": look.vertices,
        "trail": look.trail,
        "colours": colours,
        "opacity": [round_digits(look.opacity_at(s), 3) for s in places],
        "size": None if look.size is None else [round_digits(look.size_at(s, 0.0), 4) for s in places],
    }


def round_digits(value: float, digits: int) -> float:
    """Return the number rounded to this many significant digits."""
    return float(f"{value:.{digits}g}")


def _to_base64(array: NDArray[np.uint8] | NDArray[np.uint16]) -> str:
    return b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode("ascii")


def _quantise_positions(shot: Snapshot) -> NDArray[np.uint16]:
    """Return the positions of a snapshot, (N, D); bodies that cannot be drawn are in the lowest corner."""
    visible = np.where(shot.visible, shot.pos.T, -np.inf)
    return quantise_positions(visible, shot.low, shot.high).T


def _quantise_headings(shot: Snapshot) -> NDArray[np.uint8]:
    return quantise_headings(np.where(shot.visible, shot.aim.T, 0.0), shot.alive & shot.visible)


def _scenery_data(shots: Sequence[Snapshot]) -> list[dict[str, Any]]:
    """Return obstacles and marks, with the first frame in which they are shown; one entry per change."""
    scenes: list[dict[str, Any]] = []
    converted: dict[Mark, dict[str, Any]] = {}  # each mark is converted once
    for k, shot in enumerate(shots):
        circles = np.column_stack([shot.obstacle_centre[:, :2], shot.obstacle_radius])
        scene = scenery_data(circles, shot.outlines, shot.marks, converted)
        if not scenes or scene != {name: scenes[-1][name] for name in scene}:
            scenes.append({"from": k, **scene})
    return scenes


def scenery_data(
    circles: NDArray[np.floating[Any]],
    outlines: Sequence[NDArray[np.floating[Any]]],
    marks: Sequence[Mark],
    converted: dict[Mark, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return obstacles and marks as JSON: circles (M, 3), centres and radii, m; polygons, each (n, 2) m; marks.

    converted: marks that were converted before, to which others are added.
    """
    known = {} if converted is None else converted
    return {
        "stones": [[round_digits(x, 6) for x in circle] for circle in circles.tolist()],
        "walls": [[[round_digits(x, 6) for x in corner] for corner in each.tolist()] for each in outlines],
        "marks": [known.get(mark) or known.setdefault(mark, _mark_data(mark)) for mark in marks],
    }


def _mark_data(mark: Mark) -> dict[str, Any]:
    norm = float(np.linalg.norm(mark.vector)) or 1.0
    return {
        "kind": mark.kind,
        "at": [round_digits(x, 6) for x in mark.at[:2]],
        "vector": [round_digits(x, 6) for x in mark.vector[:2] / norm],
        "radius": round_digits(mark.radius, 6),
    }
