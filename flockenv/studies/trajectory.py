"""Recorded runs: instants of one world in memory, and on disk as plain arrays with a summary in JSON."""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import write_all_or_none
from flockenv.geometry.space import Plane
from flockenv.model.snapshot import Snapshot
from flockenv.model.state import WORK, Floats, State
from flockenv.scene import Scene
from flockenv.scene.yaml_io import dump_scene
from flockenv.studies.measures import measure
from flockenv.studies.trajectory_table import frame_rate, write_csv, write_parquet

__all__ = ["MEMORY_LIMIT", "Trajectory", "record", "whole_steps"]

MEMORY_LIMIT = 2 * 2**30
"""Bytes of instants that are kept before a run is refused."""

PATIENCE = 1_000_000
"""Agent-steps between two calls of `progress` and checks for KeyboardInterrupt: some hundredths of a second."""

FORMAT = 1


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T instants of one world, the first at the start and the last where the run ended."""

    scene: Scene  # that was run
    seed: int  # of the run
    step: NDArray[np.int64]  # (T,) physics steps since the start; time = step dt
    pos: Floats  # (T, N, D) m
    vel: Floats  # (T, N, D) m/s
    alive: NDArray[np.bool_]  # (T, N)
    first: State
    last: State
    wall: float  # s, without compiling
    stopped: str  # reason if it ended early, else ""
    heading: Floats | None = None  # (T, N, D) directions that agents face, of scenes that keep headings
    identity: NDArray[np.int64] | None = None  # (T, N) the agent in each slot, of scenes with a population
    born: NDArray[np.float64] | None = None  # (T, N) s, times of birth
    shown: NDArray[np.float64] | None = None  # (T, N) strains or inner numbers, of scenes whose pictures show them
    broken: NDArray[np.bool_] | None = None  # (T, E) edges of networks that are broken, of scenes whose springs break

    @property
    def rate(self) -> float:
        """Agent-steps per second of wall time; NaN for a run without steps."""
        return self.scene.agents * int(self.step[-1]) / self.wall if self.step[-1] and self.wall > 0 else math.nan

    def measures(self, progress: Callable[[int], None] = lambda done: None) -> dict[str, tuple[float, float]]:
        """Return every domain measure at the start and at the end.

        progress: called with the number of agents measured, out of twice those of the scene.
        """
        agents = self.scene.agents
        start = measure(self.scene, self.first, progress=progress)
        progress(agents)
        same = self.last is self.first
        end = start if same else measure(self.scene, self.last, progress=lambda done: progress(agents + done))
        return {name: (start[name], end[name]) for name in start}

    def snapshots(self, title: str = "") -> Iterator[Snapshot]:
        """Return every instant, ready to be drawn, all in one frame: the space, or the box of all positions.

        title: text above each picture.
        """
        times = (self.step * self.scene.dt).tolist()
        low, high = _region(self.scene, self.pos, self.alive, times)
        start = replace(
            self.scene.snapshot(self.first, title=title), outlines=self.scene.view.outlines(low, high, times[0])
        )
        for k, time in enumerate(times):
            walls = self.scene.view.outlines(low, high, time) if self.scene.parts.moving else start.outlines
            yield replace(
                start, time=time, pos=self.pos[k], vel=self.vel[k], alive=self.alive[k], low=low, high=high,
                heading=None if self.heading is None else self.heading[k], outlines=walls,
                identity=None if self.identity is None else self.identity[k],
                age=None if self.born is None else time - self.born[k],
                shown=None if self.shown is None else self.shown[k],
                broken=None if self.broken is None else self.broken[k],
            )  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """Return a summary without arrays, ready for JSON: numbers without a meaning are null, never NaN."""
        return {
            "format": FORMAT,
            "scene": self.scene.model_dump(mode="json"),
            "seed": self.seed,
            "steps": int(self.step[-1]),
            "time_s": float(self.last.time[0]),
            "instants": len(self.step),
            "frame_rate": frame_rate(self),
            "stopped": self.stopped,
            "measures": {name: {"start": _json(a), "end": _json(b)} for name, (a, b) in self.measures().items()},
            "digest": self.last.digest,
            "work": {what: self.last.count_of(what) for what in WORK},
            "wall_s": self.wall,
            "agent_steps_per_s": _json(self.rate),
        }

    def save(self, path: Path) -> Path:
        """Write X.npz and X.json beside it, both or neither; return the path of the latter.

        X.csv and X.parquet are tables of positions, see `trajectory_table`. What X.npz contains:

        Arrays: time (T,) s, pos (T, N, D) m, vel (T, N, D) m/s, alive (T, N), radius (N,) m, seed, and `scene`, the
        YAML text that `load_scene` reads; heading (T, N, D) where headings are kept; identity and born (T, N), s, where
        there is a population; shown (T, N), if pictures show strains or inner numbers; broken (T, E), if springs yield
        or break. None needs pickle. Missing folders are created.
        """
        write = {".csv": write_csv, ".parquet": write_parquet}.get(path.suffix.lower())
        beside = path.with_suffix(".json")
        summary = json.dumps(self.summary(), indent=2, allow_nan=False) + os.linesep
        write_all_or_none(
            path.parent,
            {
                path.name: self._write if write is None else functools.partial(write, self),
                beside.name: lambda part: part.write_bytes(summary.encode()),
            },
        )
        return beside

    def _write(self, path: Path) -> None:
        names = ("heading", "identity", "born", "shown", "broken")
        kept = {name: getattr(self, name) for name in names}
        more: dict[str, Any] = {name: array for name, array in kept.items() if array is not None}
        with path.open("wb") as file:
            np.savez(
                file, time=self.step * self.scene.dt, pos=self.pos, vel=self.vel, alive=self.alive,
                radius=self.scene.body.radius, seed=np.uint64(self.seed), scene=np.array(dump_scene(self.scene)),
                **more,
            )  # fmt: skip


def record(
    scene: Scene, seed: int, steps: int, every: int, progress: Callable[[int], None] = lambda done: None
) -> Trajectory:
    """Run a scene for `steps` physics steps and keep an instant every `every` steps, and the last one.

    seed: of the start and of all random numbers of the run.

    progress is called with the steps done, first with 0 once the scene is compiled. A KeyboardInterrupt, or a position
    that is no longer finite, ends the run early: the instants until then are returned, and `stopped` has the reason.
    Raises ValueError, before anything is computed, if the instants would take more than MEMORY_LIMIT.
    """
    film = _Film.of(scene, _count_instants(scene, steps, every))
    first = last = scene.start(seed)
    piece = max(1, PATIENCE // scene.agents)
    stopped, began = "", perf_counter()
    try:
        _compile(scene, first, steps)
        began = perf_counter()
        progress(0)
        for until in chain(range(0, steps, every), [steps]):
            while (done := int(last.tick[0])) < until:
                last = scene.run(last, min(piece, until - done))
                progress(int(last.tick[0]))
            film.keep(last)
    except KeyboardInterrupt:
        stopped = "interrupted"
    except FloatingPointError as error:
        stopped = str(error)
    wall = perf_counter() - began
    film.keep(last)
    n = len(film.step)
    step = np.array(film.step, np.int64)
    return Trajectory(
        scene, seed, step, film.pos[:n], film.vel[:n], film.alive[:n], first, last, wall, stopped,
        None if film.heading is None else film.heading[:n], None if film.identity is None else film.identity[:n],
        None if film.born is None else film.born[:n], None if film.shown is None else film.shown[:n],
        None if film.broken is None else film.broken[:n],
    )  # fmt: skip


def _compile(scene: Scene, first: State, steps: int) -> None:
    """Compile the kernels of a run, or read them from the cache, by a first step whose result is discarded."""
    if steps > 0:
        with suppress(FloatingPointError):  # the run itself reports a divergence
            scene.run(first, 1)


@dataclass(frozen=True, eq=False)
class _Film:
    """Arrays for all instants of a run, and the number of instants kept."""

    pos: Floats
    vel: Floats
    alive: NDArray[np.bool_]
    heading: Floats | None
    identity: NDArray[np.int64] | None
    born: NDArray[np.float64] | None
    shown: NDArray[np.float64] | None
    broken: NDArray[np.bool_] | None
    scene: Scene
    step: list[int]

    @classmethod
    def of(cls, scene: Scene, instants: int) -> _Film:
        shape = (instants, scene.agents, scene.dimension)
        pos, vel, heading = (np.empty(shape, scene.dtype) for _ in range(3))
        who, since = (np.empty(shape[:2], np.int64), np.empty(shape[:2])) if scene.population else (None, None)
        faced = heading if scene.parts.oriented else None
        shown = np.empty(shape[:2]) if any(look.reads_scene for look in scene.view.looks) else None
        broken = np.zeros((instants, len(scene.edges)), np.bool_) if scene.parts.keeps_bonds else None
        return cls(pos, vel, np.empty(shape[:2], np.bool_), faced, who, since, shown, broken, scene, [])

    def keep(self, state: State) -> None:
        """Add an instant, unless it has been kept already."""
        k, step = len(self.step), int(state.tick[0])
        if not k or step > self.step[-1]:
            self.pos[k], self.vel[k], self.alive[k] = state.pos[0], state.vel[0], state.alive[0]
            if self.heading is not None:
                self.heading[k] = state.heading[0]
            if self.identity is not None and self.born is not None:
                self.identity[k], self.born[k] = state.identity[0], state.born[0]
            if self.shown is not None:
                self.shown[k] = self.scene.view.shown_numbers(state)
            if self.broken is not None:
                self.broken[k] = self.scene.view.broken(state)
            self.step.append(step)


def _count_instants(scene: Scene, steps: int, every: int) -> int:
    if steps < 0 or every < 1:
        raise ValueError(f"steps = {steps} must be at least 0 and every = {every} at least 1")
    instants = 1 + -(-steps // every)
    each = scene.agents * ((2 + scene.parts.oriented) * scene.dimension * np.dtype(scene.dtype).itemsize + 1)
    each += (16 * bool(scene.population) + 8 * any(look.reads_scene for look in scene.view.looks)) * scene.agents
    each += len(scene.edges) if scene.parts.keeps_bonds else 0
    needed = instants * (each + 40)  # the step is a Python number in a list
    if needed > MEMORY_LIMIT:
        rarer = every * math.ceil(needed / MEMORY_LIMIT) * scene.dt
        raise ValueError(
            f"{instants:,} instants of {scene.agents:,} agents need about {needed / 2**30:.3g} GiB, at most "
            f"{MEMORY_LIMIT / 2**30:g} are kept: keep one every {rarer:g} s, or shorten the run"
        )
    return instants


def whole_steps(name: str, seconds: float, dt: float, least: int = 0) -> int:
    """Return the number of steps of dt in a time; raise ValueError, with the nearest times, if it is not an integer.

    name: of the time in the message; seconds: the time, s; dt: s; least: the smallest number that is allowed.
    """
    if not (math.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"{name} = {seconds:g}: must be a finite number of seconds >= {least * dt:g}")
    if seconds / dt > 2**53:
        raise ValueError(f"{name} = {seconds:g} s: too many steps of dt = {dt:g} s")
    steps = round(seconds / dt)
    if steps < least or abs(steps * dt - seconds) > 1e-9 * max(seconds, dt):
        near = max(least, math.floor(seconds / dt))
        allowed = f"must be a whole multiple of dt = {dt:g} s, say {near * dt:g} or {(near + 1) * dt:g}"
        raise ValueError(f"{name} = {seconds:g} s: {allowed}")
    return steps


def _region(
    scene: Scene, pos: Floats, alive: NDArray[np.bool_], times: list[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if not isinstance(scene.space, Plane):
        return np.zeros(scene.dimension), np.array(scene.space.extent(scene.dimension))
    living = alive[..., None] if scene.population and alive.any() else True  # empty slots have no position
    ends = ((np.min, np.inf), (np.max, -np.inf))
    low, high = (np.asarray(end(pos, axis=(0, 1), where=living, initial=far), np.float64) for end, far in ends)
    margin = 1.0 + 0.05 * float((high - low).max())
    shown = scene.view.extremes(*(times if scene.parts.moving else times[:1]))
    every = np.concatenate([[low - margin], [high + margin], *shown])
    return every.min(axis=0), every.max(axis=0)


def _json(value: float) -> float | None:
    return value if math.isfinite(value) else None
