"""Measures of a run: those that apply to its scene, their values, and the data for pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.space import Plane
from flockenv.physics.population import Emitter
from flockenv.scene import Scene
from flockenv.studies import measures as m
from flockenv.studies.measures.bodies import bodies_of, outside_networks
from flockenv.studies.measures.polygons import contains, rectangle, valid_polygon
from flockenv.studies.trajectory import Trajectory

__all__ = ["UNITS", "Scope", "Survey", "mean_measures", "survey"]

Floats = NDArray[np.float64]

INSTANTS, FEWEST, MOST_CELLS = 200, 10, 400_000
"""Evenly spaced instants at which cells, lanes and order are measured; fewer if that is more than MOST_CELLS cells."""

MOST_DEALT = 20_000_000
"""Largest number of permuted directions, in all, for the null hypothesis of lanes."""

SAMPLES = 100
"""Samples of a power law that are drawn to test whether gaps follow one."""

UNITS = {
    "agents": "alive, mean",
    "speed": "m/s, mean",
    "forward": "crossed the line to its right",
    "backward": "crossed it to its left",
    "flow": "1/s, forward less backward",
    "specific flow": "1/(m s), the same per width of the line",
    "both ways": "1/(m s), forward and backward added",
    "passing": "1/s, forward, from the first to the last: J",
    "time gap": "s, mean between two agents that go forward",
    "tail exponent": "alpha of p(gap) ~ gap^-alpha; > 2 flows, <= 2 clogs",
    "tail error": "its standard error",
    "tail start": "s, where the power law begins",
    "tail p": "how often a power law looks less like one; below .1 it is none",
    "bursts": "runs of crossings one way",
    "burst length": "crossings in a burst, mean",
    "burst length by chance": "the same of a coin",
    "bursts p": "that chance makes so few bursts, or fewer",
    "out": "of the agents that began before the line",
    "95 % out": "s, when 95 % of them were beyond it for good",
    "all out": "s, when all were",
    "density counted": "1/m^2 in the area, mean",
    "density": "1/m^2, by Voronoi cells, mean",
    "walking speed": "m/s in the area, by Voronoi cells, mean",
    "density times speed": "1/(m s), mean",
    "off Weidmann": "m/s, mean, over .5 to 3 per m^2",
    "off Weidmann, worst": "m/s, of means over .5 per m^2",
    "in Juelich bins": "share of ug-180's bins that were met within a deviation",
    "lanes": "Phi, 1 = no row holds agents of both directions",
    "lanes by chance": "Phi with permuted directions",
    "lanes p": "that chance makes as much order",
    "band index": "Y, the same over wider bands, not squared",
    "polarisation": "0 to 1: length of the mean heading",
    "milling": "0 to 1: how far all circle one way",
    "group momentum": "kg m/s",
    "nearest neighbour": "m, mean distance of centres",
    "groups": "of agents, each within reach of another",
    "overlap": "share of the smaller body, mean over pairs that overlap",
    "overlapping": "share of agents that overlap another",
    "collisions": "1/s, how often an agent begins to touch another",
    "oscillation": "speed backward over desired speed, mean where it is so",
    "oscillating": "share of agents that move backward",
}
"""Every measure, in the order of the table: unit and meaning of its number."""


@dataclass(frozen=True)
class Scope:
    """Where and when a run is measured."""

    line: Floats | None = None  # (2, 2) m
    area: Floats | None = None  # (n, 2) m; default: the whole space, if it has a size
    walkable: Floats | None = None  # (n, 2) m; default: derived from the scene
    skip: float = 0.0  # s, left out at the beginning

    def check(self, scene: Scene) -> None:
        """Raise ValueError if a line or an area is given for a 3-D scene."""
        if scene.dimension == 3 and (self.line is not None or self.area is not None or self.walkable is not None):
            raise ValueError("dimension = 3: lines and areas can only be given in 2-D")


@dataclass(frozen=True, eq=False)
class Survey:
    """The measures of a run."""

    values: dict[str, float]  # by names of UNITS; NaN if a measure has no meaning
    axis: Floats  # (2,) the walking direction
    direction: NDArray[np.int64]  # (N,) 1 = along it, -1 = against it, 0 = neither
    stopped: str = ""  # why it ended early
    density: Floats = field(default_factory=lambda: np.zeros(0))  # (S,) 1/m^2, by cells
    speed: Floats = field(default_factory=lambda: np.zeros(0))  # (S,) m/s
    gaps: Floats = field(default_factory=lambda: np.zeros(0))  # (G,) s


def survey(
    trajectory: Trajectory, scope: Scope, progress: Callable[[int], None] = lambda done: None
) -> Survey:  # fmt: skip
    """Return the measures of a run that apply to its scene.

    trajectory: the run, by `record`; scope: the line, the areas and the time that count; `progress` is called with the
    number of parts done, of six.

    A KeyboardInterrupt ends it early: the measures so far are returned, with `stopped` = "interrupted".
    """
    run = _Run.of(trajectory, scope)
    found: dict[str, Any] = {}
    values: dict[str, float] = {}
    stopped = trajectory.stopped
    try:
        for done, part in enumerate((_motion, _flow, _room, _lanes, _order, _bodies)):
            progress(done)
            numbers, arrays = part(run)
            values |= numbers
            found |= arrays
    except KeyboardInterrupt:
        stopped = "interrupted"
    return Survey({name: values[name] for name in UNITS if name in values}, run.axis, run.direction, stopped, **found)


Part = tuple[dict[str, float], dict[str, Floats]]


@dataclass(frozen=True, eq=False)
class _Run:
    """A run, with the first instant after the skipped time, and the walking direction."""

    scene: Scene
    scope: Scope
    time: Floats  # (T,) s, of all instants
    pos: NDArray[np.floating[Any]]  # (T, N, D)
    vel: NDArray[np.floating[Any]]
    alive: NDArray[np.bool_]
    identity: NDArray[np.int64] | None
    first: int  # the first instant that is measured
    axis: Floats
    direction: NDArray[np.int64]
    low: Floats  # corners of the region
    high: Floats

    @classmethod
    def of(cls, run: Trajectory, scope: Scope) -> _Run:
        """Return a trajectory with its walking direction; raise ValueError if a line or area is given in 3-D."""
        scene, time = run.scene, np.asarray(run.step * run.scene.dt, np.float64)
        scope.check(scene)
        alive = run.alive & np.isfinite(run.pos).all(axis=2)
        first = min(int(np.searchsorted(time, scope.skip - 1e-9)), len(time) - 1)
        axis = _axis(run, alive, scope.line)
        along = np.where(alive, run.vel[..., :2] @ axis, 0.0)[first:].sum(axis=0)
        shown = next(iter(run.snapshots()))
        return cls(
            scene, scope, time, run.pos, run.vel, alive, run.identity, first, axis, np.sign(along).astype(np.int64),
            np.array(shown.low[:2]), np.array(shown.high[:2]),
        )  # fmt: skip

    @property
    def period(self) -> tuple[float, float]:
        """Period of a periodic world, m; 0 if it is not periodic."""
        size = self.scene.space.extent(self.scene.dimension) if self.scene.space.periodic else (0.0, 0.0)
        return size[0], size[1]

    @property
    def area(self) -> Floats | None:
        """The measured area: the given one, else the whole space if it has a size, else None."""
        if self.scope.area is not None or self.scene.dimension == 3:
            return self.scope.area
        return None if isinstance(self.scene.space, Plane) else rectangle(self.low, self.high)

    def ground(self) -> m.Ground:
        """Return the walkable area, less static obstacles, and the measured area."""
        hollow = [s for s in self.scene.shapes if s.is_hollow and not s.moves]
        if self.scope.walkable is not None:
            walk = valid_polygon("walkable", self.scope.walkable)
        elif len(hollow) == 1:
            walk = valid_polygon("walkable", hollow[0].polygons(self.low, self.high)[0])
        else:
            walk = rectangle(self.low, self.high)
        solid = [s for s in self.scene.obstacles if not (s.is_hollow or s.moves)]
        holes = [polygon for s in solid for polygon in s.polygons(self.low, self.high)]
        return m.Ground.of(walk, self.area, holes, self.period)

    def instants(self) -> list[int]:
        """Return the indices of evenly spaced instants after the skipped time."""
        most = min(INSTANTS, max(FEWEST, MOST_CELLS // self.scene.agents), len(self.time) - self.first)
        return sorted({round(float(k)) for k in np.linspace(self.first, len(self.time) - 1, most)})

    def worlds(self) -> Iterator[tuple[Floats, Floats, NDArray[np.bool_]]]:
        """Yield positions and velocities of living agents at those instants, and the mask of living agents."""
        for k in self.instants():
            here = self.alive[k]
            yield np.asarray(self.pos[k, here], float), np.asarray(self.vel[k, here], float), here


def _axis(run: Trajectory, alive: NDArray[np.bool_], line: Floats | None) -> Floats:
    """Return the walking direction, (2,): across the line, or the principal axis of all velocities."""
    if line is not None:
        along = line[1] - line[0]
        return np.asarray(np.array([along[1], -along[0]]) / np.hypot(*along))
    v = np.where(alive[..., None], run.vel[..., :2], 0.0).reshape(-1, 2).astype(float)
    vectors = np.linalg.eigh(np.nan_to_num(v.T @ v))[1]
    axis = vectors[:, 1]
    if not isinstance(run.scene.space, Plane) or np.abs(axis).max() > 0.996:  # 5 degrees
        axis = np.eye(2)[int(np.abs(axis).argmax())]
    return np.asarray(axis * (1 if axis[np.abs(axis).argmax()] > 0 else -1))


def _mean(values: Sequence[float]) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    finite = [x for x in values if math.isfinite(x)]
    return float(np.mean(finite)) if finite else np.nan


def _motion(run: _Run) -> Part:
    speed = [_mean(np.linalg.norm(vel, axis=1).tolist()) for _, vel, _ in run.worlds()]
    return {"agents": float(run.alive[run.first :].sum(axis=1).mean()), "speed": _mean(speed)}, {}


def _flow(run: _Run) -> Part:
    """Measure flow, gaps, bursts and evacuation at the line."""
    if run.scope.line is None:
        return {}, {}
    line = run.scope.line
    every = m.crossings(run.time, run.pos, line, run.alive, run.identity, run.period)
    late = every.time >= run.time[run.first]
    found = m.Crossings(*(each[late] for each in every))
    lasted = float(run.time[-1] - run.time[run.first])
    values: dict[str, float] = {}
    if lasted > 0:
        width = float(np.hypot(*(line[1] - line[0])))
        through = m.flow(found, width, lasted)
        names = ("forward", "backward", "flow", "specific flow", "passing")
        values |= dict(zip(names, map(float, through), strict=True))
        values["both ways"] = len(found.time) / lasted / width
    gaps = m.time_gaps(found)
    fit, burst = m.tail(gaps), m.bursts(found.sign)
    values |= {
        "time gap": _mean(gaps.tolist()), "tail exponent": fit.alpha, "tail error": fit.error, "tail start": fit.start,
        "tail p": m.goodness(gaps, fit, SAMPLES),
    }  # fmt: skip
    if {*found.sign.tolist()} == {1, -1}:
        values |= {
            "bursts": float(burst.bursts), "burst length": burst.length, "burst length by chance": burst.null_length,
            "bursts p": burst.p,
        }  # fmt: skip
    return values | _evacuation(run, every, line), {"gaps": gaps}


def _evacuation(run: _Run, every: m.Crossings, line: Floats) -> dict[str, float]:
    """Measure when the agents that began before the line left; {} with emitters or in a periodic world."""
    if run.scene.space.periodic or any(isinstance(member, Emitter) for member in run.scene.population):
        return {}
    along, to = line[1] - line[0], run.pos[0] - line[0]
    before = (along[0] * to[:, 1] - along[1] * to[:, 0] >= 0) & run.alive[0]
    if not before.any():
        return {}
    left = m.last_crossing(every, run.pos.shape[1])[before]
    return {
        "out": float(np.isfinite(left).sum()),
        "95 % out": m.evacuation_time(left, 0.95),
        "all out": m.evacuation_time(left),
    }


def _room(run: _Run) -> Part:
    """Measure density and speed in the area."""
    area = run.area
    if area is None:
        return {}, {}
    ground, counted, density, speed = run.ground(), [], [], []
    for pos, vel, _ in run.worlds():
        room = ground.room(pos)
        counted.append(float(m.classical_density(pos[None], area)[0]))
        density.append(m.voronoi_density(room))
        speed.append(m.voronoi_speed(room, np.linalg.norm(vel, axis=1)))
    rho, v = np.array(density), np.array(speed)
    off = m.weidmann_deviation(rho, v)
    values = {
        "density counted": _mean(counted), "density": _mean(density), "walking speed": _mean(speed),
        "density times speed": _mean((rho * v).tolist()), "off Weidmann": off.mean, "off Weidmann, worst": off.worst,
        "in Juelich bins": m.juelich_share(rho, v),
    }  # fmt: skip
    return values, {"density": rho, "speed": v}


def _lanes(run: _Run) -> Part:
    """Measure lanes, if agents walk in both directions and mostly along the axis."""
    if run.scene.dimension == 3:
        return {}, {}
    at, across = run.instants(), np.array([-run.axis[1], run.axis[0]])
    pos, alive = np.asarray(run.pos[at], float), run.alive[at]
    here = alive if run.area is None else alive & contains(valid_polygon("area", run.area), pos)
    seen = here.any(axis=0)
    both = (run.direction[seen] > 0).any() and (run.direction[seen] < 0).any()
    if not both or not _is_straight(run):
        return {}, {}
    y = pos @ across
    low, high = float(y[here].min()), float(y[here].max())
    deals = min(400, max(50, MOST_DEALT // y.shape[1]))
    found = m.lanes(y, run.direction, low, high + 1e-9 * (1 + abs(high)), here, deals=deals)
    return {"lanes": found.order, "lanes by chance": found.null, "lanes p": found.p, "band index": found.bands}, {}


def _is_straight(run: _Run) -> bool:
    """Return True if more than half of all movement is along the axis, in either direction."""
    v = np.where(run.alive[..., None], run.vel[..., :2], 0.0)[run.first :]
    along, total = np.abs((v @ run.axis).sum(axis=0)).sum(), np.linalg.norm(v, axis=2).sum()
    return bool(along > 0.5 * total)


def _order(run: _Run) -> Part:
    space, mass, reach = run.scene.space, np.asarray(run.scene.body.mass, float), run.scene.parts.reach
    rows: list[tuple[float, ...]] = []
    loose = outside_networks(run.scene)
    for pos, vel, here in run.worlds():
        near = m.nearest_distances(pos, space)[0]
        groups = m.components(pos, reach, space) if reach > 0 and len(pos) else np.nan
        rows.append((
            m.polarisation(vel[loose[here]]), m.milling(pos, vel, space), m.group_momentum(vel, mass[here]),
            _mean(near.tolist()), groups,
        ))  # fmt: skip
    names = ("polarisation", "milling", "group momentum", "nearest neighbour", "groups")
    meant = {"polarisation": loose.any(), "groups": reach > 0}
    columns = zip(names, zip(*rows, strict=True), strict=False)
    return {name: _mean(column) for name, column in columns if meant.get(name, True)}, {}


def _bodies(run: _Run) -> Part:
    """Measure overlaps, collisions and backward motion."""
    radius, space = np.asarray(run.scene.body.radius, float), run.scene.space
    at = slice(run.first, None)
    values: dict[str, float] = {}
    body = bodies_of(run.scene)
    if radius.any():
        if run.scene.dimension == 2:
            pos, alive = run.pos[run.instants()], run.alive[run.instants()]
            found = m.overlap_proportion(pos, radius, space, alive, body)
            values |= {"overlap": found.mean, "overlapping": found.share}
        values["collisions"] = m.collision_rate(run.time[at], run.pos[at], radius, space, run.alive[at], body)
    made = run.scene.body  # without a desired speed it is max_speed
    speed = np.asarray(np.where(made.desired_speed > 0, made.desired_speed, made.max_speed), float)
    if run.scene.dimension == 2 and np.isfinite(speed).all() and _is_straight(run):
        desired = (run.direction * speed)[:, None] * run.axis
        back = m.oscillation_proportion(run.vel[at], desired, run.alive[at])
        values |= {"oscillation": back.mean, "oscillating": back.share}
    return values, {}


def mean_measures(found: Sequence[Survey]) -> dict[str, m.Mean]:
    """Return the mean of every measure over runs, with its 95 % interval.

    found: a survey of each run.
    """
    names = [name for name in UNITS if any(name in each.values for each in found)]
    return {name: m.mean_of_runs([each.values.get(name, np.nan) for each in found]) for name in names}
