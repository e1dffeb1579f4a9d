"""Initial positions of agents: drawn from the world's RNG key, clear of obstacles, independent of the batch size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.core.record import Record
from flockenv.geometry.shapes import Shape, distance_to_shapes
from flockenv.jit.decorators import kernel
from flockenv.maths.counter_rng import uniform

__all__ = ["Spawn", "cells", "direction", "scatter"]

Edge = Annotated[float, Field(gt=0)]

TRIES = 64
"""Positions tried per agent, after which the one with the least overlap is taken."""

MOST_CELLS = 10_000_000
"""Most cells of a grid that are searched for free ones."""


class Spawn(Record):
    """Positions uniform in a box (default: the space), at speeds from a range, in a random or a given direction.

    With `spacing` each agent has its own cell of a grid; bodies then do not overlap, unless `wider` is set.
    """

    kind: Literal["uniform"] = "uniform"
    sentence: ClassVar[str] = "placed at random[ from {low}][ to {high}]"
    low: tuple[float, ...] | None = Field(default=None, description="m, lower corner")
    high: tuple[float, ...] | None = Field(default=None, description="m, upper corner")
    spacing: Edge | tuple[Edge, ...] | None = Field(
        default=None,
        description="m, edge of cells, or one edge per axis; from `low` on, along the first axis first; each agent is "
        "in the middle of a cell that is clear of obstacles (default: anywhere, bodies may overlap)",
    )  # fmt: skip
    jitter: float = Field(
        default=0.0, ge=0, description="m, greatest distance from the middle of its cell along each axis"
    )
    wider: bool = Field(
        default=False,
        description="True: bodies may be wider than their cells, and overlap others and obstacles at the start",
    )
    speed: tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]] = Field(
        default=(0.0, 0.0), description="m/s, least and most"
    )
    heading: tuple[float, ...] | None = Field(default=None, description="direction of the velocity (default: random)")

    @model_validator(mode="after")
    def _check_ranges(self) -> Spawn:
        """Raise ValueError if a range is reversed, or a field is given without the one that it needs."""
        if self.speed[0] > self.speed[1]:
            raise ValueError(f"speed = {self.speed}: the lower number must come first")
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high go together: give both or neither")
        corners = tuple(zip(self.low or (), self.high or (), strict=False))
        if len(self.low or ()) != len(self.high or ()) or any(a > b for a, b in corners):
            raise ValueError(f"low = {self.low}, high = {self.high}: the lower corner comes first")
        if self.jitter and self.spacing is None:
            raise ValueError(f"jitter = {self.jitter:g}: needs spacing, the grid in whose cells agents are moved")
        if self.wider and self.spacing is None:
            raise ValueError("wider = true: needs spacing, and then allows bodies that are wider than a cell")
        return self


def cells(
    spawn: Spawn, low: Sequence[float], high: Sequence[float], count: int, radius: float, shapes: Sequence[Shape],
    period: NDArray[np.float64],
) -> NDArray[np.float64]:  # fmt: skip
    """Return the middles of the first grid cells in [low, high) that are clear of shapes, (count, D) m.

    spawn: its spacing, m, and `wider` define the grid; low, high: corners of the region, (D,) m; count: number of
    cells; period: (D,) m, size of a periodic box, zeros for none.

    Raises ValueError, beginning with the field's name, if bodies of this radius, m, are wider than a cell, or if there
    are too few free cells.
    """
    dimension, body = len(low), 0.0 if spawn.wider else radius
    spacing = _edges(spawn, dimension, radius)
    along = [math.floor((b - a) / edge + 1e-9) for a, b, edge in zip(low, high, spacing, strict=True)]
    total = math.prod(along)
    if total > MOST_CELLS:
        raise ValueError(
            f"spacing = {_edges_text(spacing)}: a grid of {total:,} cells; at most {MOST_CELLS:,} are allowed"
        )
    found = np.zeros((0, dimension))
    for first in range(0, total, 65_536):
        if len(found) >= count:
            break
        ids = np.unravel_index(np.arange(first, min(first + 65_536, total)), along, order="F")
        middles = np.array(low, float) + np.array(spacing) * (np.stack(ids, axis=1) + 0.5)
        free = distance_to_shapes(shapes, middles, period) >= body + spawn.jitter * math.sqrt(dimension)
        found = np.concatenate([found, middles[free]])
    if len(found) < count:
        raise ValueError(
            f"spacing = {_edges_text(spacing)}: there is room for only {len(found):,} of {count:,} agents "
            f"from {tuple(low)} to {tuple(high)}"
        )
    return found[:count]


def _edges(spawn: Spawn, dimension: int, radius: float) -> tuple[float, ...]:
    """Return the edges of a spawn's cells, (D,) m; raise ValueError if bodies of this radius, m, do not fit."""
    given = spawn.spacing if isinstance(spawn.spacing, tuple) else (spawn.spacing or 0.0,) * dimension
    if len(given) != dimension:
        raise ValueError(f"spacing = {given}: must be one edge, or one per axis ({dimension})")
    least = 2 * (radius + spawn.jitter)
    if not spawn.wider and min(given) < least * (1 - 1e-12):
        raise ValueError(
            f"spacing = {_edges_text(given)}: bodies of radius {radius:g} m, up to {spawn.jitter:g} m from the middle "
            f"of their cells, need at least {least:g} m"
        )
    return given


def _edges_text(spacing: tuple[float, ...]) -> str:
    """Return the edges of a cell as text for messages: one number, or all if they differ."""
    return f"{spacing[0]:g}" if len(set(spacing)) == 1 else f"({', '.join(f'{edge:g}' for edge in spacing)})"


@kernel
def direction(key: Any, step: int, agent: int, channel: int, out: Any) -> None:
    """Write a uniformly distributed unit vector (2-D or 3-D) into `out` (D,).

    key: of the world; step, agent, channel: as of `counter_rng.uniform`; in 3-D it also draws from channel + 1.
    """
    turn = 2.0 * math.pi * uniform(key, step, agent, channel)
    if out.shape[0] == 2:
        out[0], out[1] = math.cos(turn), math.sin(turn)
    else:
        z = 2.0 * uniform(key, step, agent, channel + 1) - 1.0
        ring = math.sqrt(max(0.0, 1.0 - z * z))
        out[0], out[1], out[2] = ring * math.cos(turn), ring * math.sin(turn), z


@kernel
def _overlap(pos: Any, i: int, radius: float, centre: Any, obstacle_radius: Any, period: Any) -> float:
    """Return the deepest overlap of agent i with an obstacle, m; 0 if it is clear."""
    worst = 0.0
    for m in range(obstacle_radius.shape[0]):
        if obstacle_radius[m] > 0:
            square = 0.0
            for k in range(pos.shape[0]):
                d = pos[k, i] - centre[k, m]
                d -= period[k] * math.floor(d / period[k] + 0.5) if period[k] > 0.0 else 0.0
                square += d * d
            worst = max(worst, obstacle_radius[m] + radius - math.sqrt(square))
    return worst


@kernel
def scatter(
    key: Any, pos: Any, vel: Any, radius: Any, first: int, end: int, low: Any, high: Any, slow: float, fast: float,
    heading: Any, centre: Any, obstacle_radius: Any, period: Any, unit: Any, tried: Any,
) -> None:  # fmt: skip
    """Place agents [first, end) of one world uniformly in [low, high), clear of obstacles if 64 tries suffice.

    key: of the world. radius (N,) m; slow, fast: m/s, speeds are uniform between them; centre (D, M) m and
    obstacle_radius (M,) m: the obstacles, radius 0 for none.

    pos, vel (D, N); low, high, heading, period, unit (D,); heading: zeros for a random one; period: size of a periodic
    box, zeros for none; unit: scratch. tried (N,): on entry the number of tries already made, on return the index of
    the accepted one.
    """
    dimension = pos.shape[0]
    for i in range(first, end):
        best, kept = 1e300, tried[i]
        for t in range(tried[i], tried[i] + TRIES):
            for k in range(dimension):
                pos[k, i] = low[k] + (high[k] - low[k]) * uniform(key, t, i, k)
            overlap = _overlap(pos, i, radius[i], centre, obstacle_radius, period)
            if overlap < best:
                best, kept = overlap, t
            if overlap <= 0.0:
                break
        for k in range(dimension):
            pos[k, i] = low[k] + (high[k] - low[k]) * uniform(key, kept, i, k)
        tried[i] = kept
        speed = slow + (fast - slow) * uniform(key, 0, i, 3)
        direction(key, 0, i, 4, unit)
        length = 0.0
        for k in range(dimension):
            length += heading[k] * heading[k]
        for k in range(dimension):
            vel[k, i] = speed * (heading[k] / math.sqrt(length) if length > 0.0 else unit[k])
