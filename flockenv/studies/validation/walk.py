"""People of a preset, scenes they walk in, and records of runs: instants of all worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes import Wall
from flockenv.model.distribution import Spread
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Effect, ObstacleContact
from flockenv.scene import Group, Scene
from flockenv.scene.presets import PRESETS, preset

__all__ = [
    "STEPS",
    "WEIDMANN",
    "Scenes",
    "Walk",
    "empty_group",
    "filling_grid",
    "lane",
    "people",
    "run_walk",
    "scene_of",
    "wall",
]

Floats = NDArray[np.float64]
Scenes = Mapping[str, Mapping[str, Callable[[str], Scene]]]

WEIDMANN = Spread(mean=1.34, sd=0.26, low=0.3)
"""m/s, desired speeds of pedestrians (Weidmann 1993), the default of all cases."""

STEPS = {"helbing_farkas_vicsek_2000": 0.005, "moussaid_2011": 0.05}
"""s, one step (default: .02). With friction of bodies, kappa d 2 / m < 2 / dt at 6 cm overlap d of two bodies."""

SOLID = ObstacleContact(stiffness=1.2e5)
"""Elastic walls (Helbing, Farkas and Vicsek 2000) for models without contact forces, whose crowds else cross walls."""

SHAKEN = 0.01
"""m, largest initial distance from a cell's middle, along each axis, of bodies that are wider than their cells."""

PATIENCE = 60.0
"""s without an exit, after which the people that are left count as stuck."""


class Walk(NamedTuple):
    """A recorded run: the motion of people at T instants of B worlds, and the last state."""

    time: Floats  # (T,) s
    pos: Floats  # (T, B, N, 2) m
    vel: Floats  # (T, B, N, 2) m/s
    alive: NDArray[np.bool_]  # (T, B, N)
    radius: Floats  # (N,) m
    last: State

    def leaving_times(self, world: int = 0) -> Floats:
        """Return the first instant at which each agent is gone, (N,) s; NaN if it is still there at the end."""
        here = self.alive[:, world]
        last = len(here) - 1 - here[::-1].argmax(axis=0)
        return np.where(here[-1] | ~here.any(axis=0), np.nan, self.time[np.minimum(last + 1, len(here) - 1)])


def people(name: str, count: int, low: Sequence[float], high: Sequence[float], **changes: Any) -> Group:
    """Return a group of people of a preset that begin between two corners, m, at rest and without overlap.

    Masses and radii are the preset's; speeds are Weidmann's, or those that are given.
    """
    fields = {**PRESETS[name].people, "desired_speed": WEIDMANN, **changes}
    if "spawn" not in fields:
        fields["spawn"] = _widest_grid(count, low, high, Group(count=count, **fields).widest)
    return Group(count=count, **fields)


def _widest_grid(count: int, low: Sequence[float], high: Sequence[float], widest: float) -> Spawn:
    """Return the widest grid of cells with room for `count`, each at a random place in the middle of a cell.

    If bodies are wider than such cells, they begin in the middles of the widest cells possible.
    """
    wide, deep = (b - a for a, b in zip(low, high, strict=True))
    spacing = np.sqrt(wide * deep / count)
    while int(wide / spacing + 1e-9) * int(deep / spacing + 1e-9) < count:
        spacing *= 0.995
    if spacing < 2 * widest:
        return filling_grid(count, low, high, widest)
    jitter = max(0.0, (spacing / 2 - widest) * 0.9)
    return Spawn(low=tuple(low), high=tuple(high), spacing=float(spacing), jitter=float(jitter))


def filling_grid(count: int, low: Sequence[float], high: Sequence[float], widest: float) -> Spawn:
    """Return a grid of `count` cells that fills a box, with the longest shorter edge.

    Bodies are apart if they fit in the cells; else they are up to SHAKEN from the middles of their cells.
    """
    wide, deep = (b - a for a, b in zip(low, high, strict=True))
    fitting = [(wide / -(-count // rows), deep / rows) for rows in range(1, count + 1)]
    spacing = max(fitting, key=min)
    room = min(spacing) / 2 - widest
    jitter = SHAKEN if room < 0 else room / 2
    return Spawn(low=tuple(low), high=tuple(high), spacing=spacing, jitter=jitter, wider=room < 0)


def empty_group(name: str, at: tuple[float, float], count: int) -> Group:
    """Return a group without living people."""
    return people(name, count, at, at, alive=0, spawn=Spawn(low=at, high=at), desired_speed=1.0)


def wall(*vertices: tuple[float, float]) -> Wall:
    """Return a thin wall."""
    return Wall(vertices=vertices)


def lane(length: float, width: float, begin: float = 0.0) -> tuple[Wall, ...]:
    """Return the two walls of a corridor along x, m, around y = 0."""
    return tuple(wall((begin, side * width / 2), (begin + length, side * width / 2)) for side in (-1, 1))


def scene_of(name: str, groups: Sequence[Group], aims: Sequence[Effect], **fields: Any) -> Scene:
    """Return a scene of people of a preset with these goals; bodies do not pass walls."""
    fields = {"dt": STEPS.get(name, 0.02), **fields}
    model = preset(name)
    solid = () if any(isinstance(effect, ObstacleContact) for effect in model) else (SOLID,)
    return Scene(groups=tuple(groups), effects=(*aims, *model, *solid), **fields)


def run_walk(
    scene: Scene, seconds: float, *, seed: int = 0, worlds: int = 1, every: float = 0.1,
    until: Callable[[State], bool] | None = None, begin: State | None = None,
) -> Walk:  # fmt: skip
    """Run a scene for `seconds` s, with an instant every `every` s; end early at `until`, or if all are stuck."""
    state = scene.start(seed, worlds) if begin is None else begin
    stride = max(1, round(every / scene.dt))
    kept, living, since = [state], int(state.alive.sum()), 0.0
    for _ in range(round(seconds / (stride * scene.dt))):
        state = scene.step(state, steps=stride)
        kept.append(state)
        now, many = float(state.time[0]), int(state.alive.sum())
        living, since = (many, now) if many < living else (living, since)
        if until is not None and (until(state) or now - since > PATIENCE):
            break
    time = np.array([float(s.time[0]) for s in kept])
    pos, vel, alive = (np.array([np.array(getattr(s, name)) for s in kept]) for name in ("pos", "vel", "alive"))
    return Walk(time, pos, vel, alive, np.asarray(scene.body.radius, np.float64), state)
