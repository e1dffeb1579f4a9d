"""Copying the data of a world's agents into blocks when a call begins, and back when it ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from flockenv.engine.agent_records import AgentPlan
from flockenv.engine.blocks import into_blocks, out_of_blocks, put_vector_of, vector_of_lane
from flockenv.jit.decorators import Law, kernel
from flockenv.jit.section import call_in_turn, section

__all__ = ["bring_in_of", "bring_inside_of", "bring_out_of", "take_drive_of"]


@functools.cache
def _read_number(number: int) -> Callable[..., None]:
    def read(inner: Any, array: Any, b: Any, i: Any) -> None:
        inner[number][i] = array[number, b, i]

    return kernel(read)


@functools.cache
def _write_number(number: int) -> Callable[..., None]:
    def write(inner: Any, array: Any, b: Any, i: Any) -> None:
        array[number, b, i] = inner[number][i]

    return kernel(write)


@section
def _copy_between(agent: AgentPlan, inwards: bool) -> Callable[..., None]:
    """Make `bring(worlds, scratch, b, first, end)`: copy these blocks of world b into scratch, or back."""
    d, width, oriented, inner = agent.dimension, agent.width, agent.oriented, len(agent.inner)
    copy, place = (into_blocks if inwards else out_of_blocks)(d, width), int(oriented)
    copy_numbers = call_in_turn(*map(_read_number if inwards else _write_number, range(inner)))

    def bring(worlds: Any, scratch: Any, b: Any, first: Any, end: Any) -> None:
        n = worlds.x.shape[2]
        copy(scratch.pos, worlds.x, b, n, first, end)
        copy(scratch.vel, worlds.v, b, n, first, end)
        if oriented:
            copy(scratch.facing, worlds.frame_and_inner[0][:d], b, n, first, end)
            if d == 3:
                copy(scratch.above, worlds.frame_and_inner[0][d:], b, n, first, end)
        if inner:
            for i in range(first * width, min(end * width, n)):
                copy_numbers(scratch.inner, worlds.frame_and_inner[place], b, i)

    return bring


def bring_in_of(agent: AgentPlan) -> Callable[..., None]:
    """Return `bring_in(worlds, scratch, b, first, end)`: copy these blocks of world b into scratch."""
    return _copy_between(agent, True)


def bring_out_of(agent: AgentPlan) -> Callable[..., None]:
    """Return `bring_out(worlds, scratch, b, first, end)`: copy these blocks of scratch back to world b."""
    return _copy_between(agent, False)


@section
def take_drive_of(dimension: int, width: int, masked: bool) -> Callable[..., None]:
    """Make `take_drive(scratch, drive, drive_row, n, first, end)`: copy drive[:, drive_row], commanded forces, or 0."""
    into, size = into_blocks(dimension, width), dimension * width

    def take_drive(scratch: Any, drive: Any, drive_row: Any, n: Any, first: Any, end: Any) -> None:
        if drive.shape[1] > 0:
            into(scratch.requested_force, drive, drive_row, n, first, end)
            if masked:
                scratch.spread[1] = ~np.uint64(0)
        else:
            if masked:
                scratch.requested_force[:size] = 0
                scratch.spread[1] = np.uint64(0)
            else:
                scratch.requested_force[first * size : end * size] = 0

    return take_drive


@section
def bring_inside_of(agent: AgentPlan, confine: Law) -> Callable[..., None]:
    """Make `bring_inside(scratch, size, first, end)`: move agents into a periodic box, if steps rely on it."""
    width, count = agent.width, np.uint64(agent.dimension * agent.width)
    vector, put = vector_of_lane(agent.dimension, width), put_vector_of(agent.dimension, width)

    def bring_inside(scratch: Any, size: Any, first: Any, end: Any) -> None:
        for block in range(np.uint64(first), np.uint64(end)):
            base, row = block * count, block * np.uint64(width)
            for lane in range(np.uint64(width)):
                x, v = vector(scratch.pos, base + lane), vector(scratch.vel, base + lane)
                x, v = confine(size, scratch.radius[row + lane], x, v)
                put(scratch.pos, base + lane, x)

    return bring_inside
