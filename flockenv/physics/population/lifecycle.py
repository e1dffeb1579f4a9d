"""The population of a scene as arrays, and its update at the end of every step: first deaths, then births."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flockenv.geometry.shapes.table import pack_shapes
from flockenv.geometry.space import Box
from flockenv.jit.section import entry
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.population.births import PLACE, create_births
from flockenv.physics.population.deaths import remove_at_level, remove_crowded, remove_drained, remove_expired
from flockenv.physics.population.emitters import Emitter
from flockenv.physics.population.regions import Clearing, Surface
from flockenv.physics.population.sinks import Crowding, Drain, Sink, Threshold

__all__ = ["NUMBERS", "create_initial", "make_settler"]

NUMBERS = 4
"""Scratch memory, in numbers per agent: cells, the agents in them, the agents to remove."""

WIDTH = PLACE + 8
"""Length of a row of streams."""

Part = Callable[[Floats, State, int, int], None]
"""part(x0, state, first, end): one sink, or all births, over worlds [first, end)."""


@dataclass(frozen=True, eq=False)
class _Scratch:
    """Scratch memory of one thread."""

    grid: NDArray[np.float64]  # (4, 3) corner, edges, cells, cells per metre
    cell: NDArray[np.int32]  # (N,)
    start: NDArray[np.int32]  # (N + 1,)
    order: NDArray[np.int32]  # (N,)
    doomed: NDArray[np.bool_]  # (N,)

    @classmethod
    def of(cls, agents: int, asks: bool) -> _Scratch:
        n = agents if asks else 1
        cell, start, order = (np.zeros(size, np.int32) for size in (n, n + 1, n))
        return cls(np.zeros((4, 3)), cell, start, order, np.zeros(n, np.bool_))


def _space_size(scene: SceneView, there: bool) -> NDArray[np.float64]:
    """Return the size of the space, (3,) m, if `there` is set, else zeros."""
    size = np.zeros(3)
    if there:
        size[: scene.dimension] = scene.space.extent(scene.dimension)
    return size


def _period(scene: SceneView) -> NDArray[np.float64]:
    return _space_size(scene, scene.space.periodic)


def _streams(scene: SceneView) -> tuple[Floats, Floats, float]:
    """Return a row for each rate and burst, by group; the pieces of surfaces; the largest radius of clearings, m."""
    emitters = sorted((m for m in scene.population if isinstance(m, Emitter)), key=lambda m: m.group)
    found: list[list[float]] = []
    pieces: list[Floats] = [np.zeros((0, 14))]
    clearing = 0.0
    for emitter in emitters:
        first, end = scene.starts[emitter.group], scene.starts[emitter.group + 1]
        rows = emitter.rows(first, end, scene.dimension)
        if isinstance(emitter.place, Surface):
            at = sum(map(len, pieces))
            pieces.append(emitter.place.pieces())
            rows = [[*row, at, at + len(pieces[-1])] for row in rows]
        if isinstance(emitter.place, Clearing):
            clearing = max(clearing, emitter.place.radius)
        found += rows
    table = np.zeros((len(found), WIDTH))
    for k, row in enumerate(found):
        table[k, : len(row)] = row
    return table, np.concatenate(pieces), clearing


def _make_births(scene: SceneView, scratch: _Scratch) -> Part:
    streams, pieces, clearing = _streams(scene)
    walls, size, period = isinstance(scene.space, Box), _space_size(scene, isinstance(scene.space, Box)), _period(scene)
    kernel, radius, dt = entry(create_births), scene.body.radius, float(scene.dt)
    near = (scratch.grid, scratch.cell, scratch.start, scratch.order) if clearing else (None,) * 4

    def part(x0: Floats, s: State, first: int, end: int) -> None:
        kernel(
            streams, pieces, clearing, s.x, s.v, s.frame, s.alive, s.identity, s.born, s.dies, s.tick, s.key, s.work,
            radius, dt, walls, size, period, first, end, *near,
        )  # fmt: skip

    return part


def _slots(scene: SceneView, sink: Sink) -> tuple[int, int]:
    """Return the first slot that a sink acts on, and the one after the last."""
    return (0, scene.agents) if sink.group is None else (scene.starts[sink.group], scene.starts[sink.group + 1])


def _make_expiry(scene: SceneView, sinks: Sequence[Sink], channel: int) -> Part:
    table = np.zeros((len(sinks), 9))
    for k, sink in enumerate(sinks):
        row = [sink.code, *_slots(scene, sink), *sink.row()]
        table[k, : len(row)] = row
    kernel, dt = entry(remove_expired), float(scene.dt)

    def part(x0: Floats, s: State, first: int, end: int) -> None:
        kernel(
            table, s.x, s.v, s.alive, s.identity, s.born, s.dies, s.tick, s.key, s.work, dt, first, end, channel
        )  # fmt: skip

    return part


def _make_drain(scene: SceneView, sink: Drain) -> Part:
    table, _ = pack_shapes([sink.shape], scene.dimension)
    anchor, slots = tuple(float(a) for a in sink.shape.anchor), _slots(scene, sink)
    kernel, period, dt = entry(remove_drained), tuple(_period(scene)[: scene.dimension].tolist()), float(scene.dt)

    def part(x0: Floats, s: State, first: int, end: int) -> None:
        kernel(
            table, sink.margin, slots, anchor, period, x0, s.x, s.v, s.alive, s.tick, s.work, dt, first, end
        )  # fmt: skip

    return part


def _make_crowding(scene: SceneView, sink: Crowding, channel: int, scratch: _Scratch) -> Part:
    row = np.array([sink.code, *_slots(scene, sink), *sink.row()], np.float64)
    kernel, period, dt = entry(remove_crowded), _period(scene), float(scene.dt)

    def part(x0: Floats, s: State, first: int, end: int) -> None:
        kernel(
            row, channel, s.x, s.v, s.alive, s.identity, s.born, s.tick, s.key, s.work, dt, period, first, end,
            scratch.grid, scratch.cell, scratch.start, scratch.order, scratch.doomed,
        )  # fmt: skip

    return part


def _make_threshold(scene: SceneView, sink: Threshold) -> Part:
    kernel, slots, which = entry(remove_at_level), _slots(scene, sink), scene.parts.inner.index(sink.of)

    def part(x0: Floats, s: State, first: int, end: int) -> None:
        kernel(s.inner[which], sink.level, slots, s.v, s.alive, s.work, first, end)

    return part


def _counts_agents(scene: SceneView) -> bool:
    """Return True if a member of the population counts agents near a place."""
    places = [member.place for member in scene.population if isinstance(member, Emitter)]
    return any(isinstance(m, (Crowding, Clearing)) for m in (*scene.population, *places))


def _parts(scene: SceneView) -> list[Part]:
    """Return the functions to call at the end of a step: lifetimes, sinks in the scene's order, births."""
    scratch = _Scratch.of(scene.agents, _counts_agents(scene))
    emits = any(isinstance(member, Emitter) for member in scene.population)
    mortal = any(isinstance(m, Emitter) and m.lifetime is not None for m in scene.population)
    found: list[Part] = []
    simple: list[Sink] = []
    sinks = [member for member in scene.population if isinstance(member, Sink)]
    for k, sink in enumerate([*sinks, None]):
        if sink is not None and not isinstance(sink, (Drain, Crowding, Threshold)):
            simple.append(sink)
            continue
        if simple or (mortal and k == len(sinks)):
            found.append(_make_expiry(scene, simple, k - len(simple)))
            mortal, simple = False, []
        if isinstance(sink, Drain):
            found.append(_make_drain(scene, sink))
        elif isinstance(sink, Threshold):
            found.append(_make_threshold(scene, sink))
        elif isinstance(sink, Crowding):
            found.append(_make_crowding(scene, sink, k, scratch))
    return [*found, *([_make_births(scene, scratch)] if emits else [])]


def create_initial(scene: SceneView, state: State) -> None:
    """Create the agents that are born at time 0, in place.

    scene: its population is created; state: its slots of agents that are not born yet are filled.
    """
    if any(isinstance(member, Emitter) for member in scene.population):
        _make_births(scene, _Scratch.of(scene.agents, _counts_agents(scene)))(state.x, state, 0, state.shape[0])


def make_settler(scene: SceneView) -> Callable[[Floats, Floats, State, int, int], tuple[int, int]]:
    """Return a function that updates the population at the end of a step, with scratch memory of its own.

    scene: its population is updated.
    """
    parts = _parts(scene)

    def settle(x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        for part in parts:
            part(x0, state, first, end)
        return -1, -1

    return settle
