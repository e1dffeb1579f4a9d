"""Fields: quantities of agents that colours show, quantities on a grid, measures of a world, costs of effects."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import nearest, printable
from flockenv.geometry.space import Torus
from flockenv.model.state import State
from flockenv.physics.effects import Contact
from flockenv.play.lane import Drawn, Lane, collected_warnings
from flockenv.play.scene_lane import SceneLane
from flockenv.play.task_lane import TaskLane
from flockenv.scene import Scene
from flockenv.studies.cost_breakdown import explain, variants_of
from flockenv.studies.measures import polarisation

__all__ = [
    "CELLS", "Coloured", "Grid", "colour_of", "colours_of", "costs_of", "grid_of", "measures_of", "prepare_costs",
    "scene_of",
]  # fmt: skip

CELLS = {"density": 48, "flow": 24}
"""Quantities on a grid, each with the number of cells along the longer side of the world."""

SMOOTH = 0.7
"""Standard deviation of the average over cells that the flow is, cells."""

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Coloured:
    """A quantity of each agent, and the range that colours show."""

    values: Floats  # (N,)
    low: float
    high: float
    unit: str


@dataclass(frozen=True, eq=False)
class Grid:
    """A quantity on a grid over the region that is shown."""

    levels: NDArray[np.uint8]  # (ny, nx) from the lowest row up, 255 for `high`
    high: float
    unit: str
    arrows: NDArray[np.int8] | None = None  # (2, ny, nx) of a flow: along x and y, 127 for `high`


def _speed(lane: Lane, drawn: Drawn) -> Coloured:
    speed = np.sqrt((drawn.vel**2).sum(axis=0))
    return Coloured(speed, 0.0, _largest(speed, drawn), "m/s")


def _force(lane: Lane, drawn: Drawn) -> Coloured:
    """Return the size of each agent's total acceleration, without a task's drive."""
    assert isinstance(lane, SceneLane)
    size = np.sqrt((lane.record.acceleration(lane.state.copy())[0] ** 2).sum(axis=1))
    return Coloured(size, 0.0, _largest(size, drawn), "m/s^2")


def _alignment(lane: Lane, drawn: Drawn) -> Coloured:
    """Return how well each agent's direction agrees with the mean direction, from -1 to 1."""
    length = np.sqrt((drawn.vel**2).sum(axis=0))
    unit = np.divide(drawn.vel, length, out=np.zeros_like(drawn.vel), where=length > 0)
    mean = unit[:, drawn.alive].mean(axis=1, keepdims=True) if drawn.alive.any() else unit[:, :1] * 0
    norm = float(np.linalg.norm(mean))
    return Coloured((unit * mean).sum(axis=0) / norm if norm > 0 else length * 0, -1.0, 1.0, "1")


def _pressure(lane: Lane, drawn: Drawn) -> Coloured:
    """Return the elastic contact forces of other bodies on each, added as numbers, over its surface.

    In 2-D, per metre of circumference, it is the pressure of Helbing, Farkas and Vicsek 2000.
    """
    from scipy.spatial import cKDTree

    scene = scene_of(lane)
    living = np.flatnonzero(drawn.alive)
    pos, radius = np.asarray(drawn.pos[:, living].T, float), np.asarray(scene.body.radius, float)[living]
    tree = cKDTree(scene.space.wrap(pos), boxsize=scene.space.size if isinstance(scene.space, Torus) else None)
    first, other = tree.query_pairs(2 * radius.max(initial=0.0), output_type="ndarray").T
    gap = np.linalg.norm(scene.space.displacement(pos[first], pos[other]), axis=1)
    stiffness = sum(effect.stiffness for effect in scene.effects if isinstance(effect, Contact))
    force = stiffness * np.maximum(radius[first] + radius[other] - gap, 0.0)
    total = sum(np.bincount(each, force, len(living)) for each in (first, other))
    surface = 2 * np.pi * radius if scene.dimension == 2 else 4 * np.pi * radius**2
    values = np.zeros(len(drawn.alive))
    values[living] = total / surface
    return Coloured(values, 0.0, _largest(values, drawn), "N/m" if scene.dimension == 2 else "N/m^2")


def _strain(lane: Lane, drawn: Drawn) -> Coloured:
    """Return the mean strain of the edges at each agent, as of appearances."""
    assert isinstance(lane, SceneLane)
    strain = lane.record.view.strain(lane.state)
    return Coloured(strain, 0.0, _largest(strain, drawn), "1")


def _inner(name: str) -> Callable[[Lane, Drawn], Coloured]:
    def values(lane: Lane, drawn: Drawn) -> Coloured:
        assert isinstance(lane, SceneLane)
        found = lane.record.inner(lane.state, name)[0]
        shown = found[drawn.alive]
        low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
        return Coloured(found, min(low, 0.0), max(high, 1.0), "1")

    return values


def _largest(values: Floats, drawn: Drawn) -> float:
    return max(float(values[drawn.alive].max(initial=0.0)), 1e-9)


def colours_of(lane: Lane) -> dict[str, Callable[[Lane, Drawn], Coloured]]:
    """Return the quantities of a lane's agents that colours can show, by name."""
    found: dict[str, Callable[[Lane, Drawn], Coloured]] = {"speed": _speed, "alignment": _alignment}
    if isinstance(lane, SceneLane):
        found |= {"acceleration": _force, **{name: _inner(name) for name in lane.record.parts.inner}}
        if any(isinstance(effect, Contact) for effect in lane.record.effects) and lane.record.body.radius.all():
            found["pressure"] = _pressure
        if len(lane.record.edges):
            found["strain"] = _strain
    return found


def colour_of(lane: Lane, name: str) -> Coloured:
    """Return a quantity of each agent; raise ValueError, with the allowed names, if there is none of this name."""
    known = colours_of(lane)
    if name not in known:
        hint = nearest(name, known) or ";"
        raise ValueError(f"colour = {printable(name)}: unknown{hint} allowed: {', '.join(known)}")
    return known[name](lane, lane.drawn)


def grid_of(lane: Lane, name: str) -> Grid:
    """Return the density (agents per m^2, seen from above) or the flow (density times mean velocity) on a grid.

    The flow is averaged over neighbouring cells. Raises ValueError for another name.
    """
    if name not in CELLS:
        raise ValueError(f"field = {printable(name)}: unknown{nearest(name, CELLS) or ';'} allowed: {', '.join(CELLS)}")
    drawn = lane.drawn
    low, high = np.array(drawn.low[:2]), np.array(drawn.high[:2])
    counts = np.maximum(np.rint((high - low) * CELLS[name] / float((high - low).max())).astype(int), 1)
    x, v = drawn.pos[:2, drawn.alive], drawn.vel[:2, drawn.alive]
    place = np.floor((x - low[:, None]) / (high - low)[:, None] * counts[:, None]).astype(int)
    inside = ((place >= 0) & (place < counts[:, None])).all(axis=0)
    index = place[1, inside] * counts[0] + place[0, inside]

    def summed(weights: Floats | None = None) -> Floats:
        found = np.bincount(index, weights, int(np.prod(counts))).reshape(counts[1], counts[0])
        return np.asarray(found / float(np.prod((high - low) / counts)))

    if name == "density":
        return Grid(*_levels(summed()), "1/m^2")
    return _flow(np.stack([summed(each[inside]) for each in v]), scene_of(lane).space.periodic)


def _flow(flow: Floats, periodic: bool) -> Grid:
    """Return a flow, (2, ny, nx) 1/(m s), averaged over neighbouring cells."""
    from scipy.ndimage import gaussian_filter

    flow = gaussian_filter(flow, (0, SMOOTH, SMOOTH), mode="wrap" if periodic else "constant")
    levels, high = _levels(np.hypot(*flow))
    return Grid(levels, high, "1/(m s)", np.rint(127 * flow / high).astype(np.int8))


def _levels(values: Floats) -> tuple[NDArray[np.uint8], float]:
    most = max(float(values.max()), 1e-9)
    return np.rint(255 * values / most).astype(np.uint8), most


def scene_of(lane: Lane) -> Scene:
    """Return the scene of a lane."""
    scene: Scene = lane.record.scene if isinstance(lane, TaskLane) else lane.record
    return scene


def measures_of(lane: Lane) -> dict[str, dict[str, Any]]:
    """Return measures of a lane's world now, by name: value (None without a meaning), unit and title.

    Of every world: agents, mean speed, polarisation, kinetic energy, momentum; potential energy of those effects that
    have one; of a task its return and metrics.
    """
    scene = scene_of(lane)
    state = lane.world.state if isinstance(lane, TaskLane) else lane.state  # type: ignore[attr-defined]
    alive = state.alive[0] & np.isfinite(scene.body.mass)
    mass, vel = np.asarray(scene.body.mass, float)[alive], np.asarray(state.vel[0], float)[alive]
    found: dict[str, tuple[float, str, str]] = {
        "agents": (float(state.alive[0].sum()), "1", "living agents"),
        "speed": (float(np.linalg.norm(vel, axis=1).mean()) if len(vel) else np.nan, "m/s", "mean speed"),
        "polarisation": (polarisation(vel), "1", "length of the mean heading, 0 to 1"),
        "kinetic": (float(0.5 * (mass * (vel**2).sum(axis=1)).sum()), "J", "kinetic energy"),
    }
    parts = [effect.potential(scene.groups, state, scene.space.displacement) for effect in scene.parts.effects]
    if stored := [float(part[0]) for part in parts if part is not None]:
        found["potential"] = (sum(stored), "J", "potential energy")
        found["energy"] = (sum(stored) + found["kinetic"][0], "J", "energy")
    momentum = (mass[:, None] * vel).sum(axis=0)
    found["momentum"] = (float(np.linalg.norm(momentum)), "kg m/s", "size of the total momentum")
    if isinstance(lane, TaskLane):
        found["return"] = (lane.returns, "1", "return so far, mean over learners")
        found |= {name: (value, "", name.replace("_", " ")) for name, value in lane.world.metrics(0).items()}
    return {
        name: {"value": value if np.isfinite(value) else None, "unit": unit, "title": title}
        for name, (value, unit, title) in found.items()
    }


def _of_scene(lane: Lane) -> SceneLane:
    if not isinstance(lane, SceneLane):
        raise ValueError("costs: only of scenes; the effects of a task are compiled together with its rewards")
    return lane


def prepare_costs(lane: Lane) -> None:
    """Compile what `costs_of` needs, in any thread; raise ValueError for a task."""
    lane = _of_scene(lane)
    with collected_warnings():
        variants = [lane.record.with_effects(*kept) for kept in variants_of(lane.record)]
        starts = [scene.start(lane.seed) for scene in variants]
    for scene, state in zip(variants, starts, strict=True):
        with suppress(FloatingPointError):
            scene.step(state)


def costs_of(lane: Lane) -> Callable[[], dict[str, Any]]:
    """Return a function that measures what each effect of a scene costs, us per step, as `flockenv explain` does.

    It measures from the present state on, of which it has a copy, and takes some seconds, in any thread; longer without
    `prepare_costs`. Raises ValueError for a task.
    """
    lane = _of_scene(lane)
    return functools.partial(_costs, lane.record, lane.state.copy())


def _costs(scene: Scene, state: State) -> dict[str, Any]:
    breakdown = explain(scene, state)  # without `collected_warnings`, for which edits would wait meanwhile
    rows = []
    for k, row in enumerate(breakdown.rows):
        cost = {"cost": row.cost.median, "low": row.cost.low, "high": row.cost.high}
        rows.append({"name": row.effect.kind, "path": f"effects[{k}]", **cost})
    return {"rows": rows, "step": breakdown.step, "rest": breakdown.rest}
