"""Kernels as one writes them by hand for one mix of rules: what a composed scene is measured against.

2-D, torus, semi-implicit Euler, brute force; the arguments, the checks and the limits are those of a scene. They have
the form that is fast (agents side by side in the lanes of a vector register, sums in a small scratch array, unsigned
indices, no aliasing; -0 added for an unseen neighbour, which is an addition under a mask; neighbours counted by such
additions too, with AVX2 in whole numbers; those in one place by a branch), and each knows nothing but its own mix.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from flockenv.jit.cpu import LINE, REGISTER
from flockenv.jit.decorators import like
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.memory import zeros
from flockenv.jit.pipeline import Inlined, Whole
from flockenv.maths.approximations import round_half_even
from flockenv.model.state import State
from flockenv.physics.effects.effect import separation_directions
from flockenv.scene import Scene

__all__ = ["MIXES", "by_hand"]

FAST: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy", "nogil": True, "_nrt": False}
PARTS: dict[str, Any] = {"forceinline": True, "pipeline_class": Inlined, **FAST}  # loops made vectors where they run
WIDTH = REGISTER // 4  # lanes, of doubles two registers: with AVX-512 one takes 1.4 times as long, with AVX2 as long
ROWS = 9  # of scratch: x, y, vx, vy, the steering force, alive flags, and directions of parting


@njit(**PARTS)
def _nearest_image(d, size, inverse):
    return d - size * round_half_even(d * inverse)


@njit(**PARTS)
def _load(now, x, v, alive, b, n):
    for i in range(np.uint64(n)):
        now[0, i], now[1, i] = x[0, b, i], x[1, b, i]
        now[2, i], now[3, i] = v[0, b, i], v[1, b, i]
        now[6, i] = alive[b, i]


@njit(**PARTS)
def _store(now, x, v, b, n):
    for i in range(np.uint64(n)):
        x[0, b, i], x[1, b, i] = now[0, i], now[1, i]
        v[0, b, i], v[1, b, i] = now[2, i], now[3, i]


@njit(**PARTS)
def _limit_factor(longest, square):
    one = like(square, 1.0)
    return longest / np.sqrt(square) if square > longest * longest else one


@njit(**PARTS)
def _wrap(x, size, inverse):
    inside = x - size * np.floor(x * inverse)
    zero = like(x, 0.0)
    return zero if inside >= size or inside < zero else inside


def _move(width):
    """Return a kernel that moves a world by one step and returns True if all numbers are finite."""

    @njit(**PARTS)
    def move(now, requested, body, blocks, size, dt):
        inverse, far = like(size, 1.0) / size, like(size, np.inf)
        good = True
        for block in range(blocks):
            first = np.uint64(block * width)
            for lane in range(np.uint64(width)):
                i = first + lane
                mass, fastest, strongest, living = body[0, i], body[1, i], body[2, i], now[6, i]
                fx, fy = now[4, i] + requested[0, i], now[5, i] + requested[1, i]
                share = _limit_factor(strongest, fx * fx + fy * fy) * living / mass
                vx, vy = now[2, i] + dt * (fx * share), now[3, i] + dt * (fy * share)
                dx, dy = dt * vx, dt * vy
                good &= abs(dx * dx + dy * dy + vx * vx + vy * vy) < far
                brake = _limit_factor(fastest * dt, dx * dx + dy * dy) * living
                slow = _limit_factor(fastest, vx * vx + vy * vy) * living
                now[0, i] = _wrap(now[0, i] + dx * brake, size, inverse)
                now[1, i] = _wrap(now[1, i] + dy * brake, size, inverse)
                now[2, i], now[3, i] = vx * slow, vy * slow
        return good

    return move


def _rows(width):
    """Return where each sum lies in a flat array; constant distances show the compiler that none overlap."""
    return tuple(np.uint64(k * width) for k in range(10))


def _add_coincident(width):
    """Return a kernel that adds neighbours in the same place, which are rare: a branch skips them."""
    at = _rows(width)

    @njit(**PARTS)
    def add_coincident(now, sums, counts, number, n, first, three, p):
        crowded, others = False, like(counts[0], n - 1)
        for lane in range(np.uint64(width)):
            crowded |= counts[at[2] + lane] < others
        if crowded:
            for j in range(np.uint64(n)):
                for lane in range(np.uint64(width)):
                    i = first + lane
                    dx = _nearest_image(now[0, j] - now[0, i], p[0], like(p[0], 1.0) / p[0])
                    dy = _nearest_image(now[1, j] - now[1, i], p[0], like(p[0], 1.0) / p[0])
                    square = dx * dx + dy * dy
                    if np.int32(j - first) != number[lane] and square <= like(square, 1e-30):
                        sums[at[0] + lane] += now[7, i] - now[7, j]
                        sums[at[1] + lane] += now[8, i] - now[8, j]
                        counts[at[1] + lane] += 1
                        if three:
                            sums[at[2] + lane] += now[2, j]
                            sums[at[3] + lane] += now[3, j]
                            counts[at[0] + lane] += 1

    return add_coincident


# --- what neighbours come to, by mix --------------------------------------------------------------------------------


def _three(width):
    """Return a kernel for separation, alignment and cohesion."""
    at, add_coincident = _rows(width), _add_coincident(width)

    @njit(**PARTS)
    def neighbour_force(now, sums, counts, number, n, blocks, p):
        size, apart, agree, near, w_apart, w_agree, w_near = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
        zero, one, inverse = like(size, 0.0), like(size, 1.0), like(size, 1.0) / size
        none, up, stay = like(size, -0.0), like(counts[0], 1.0), like(counts[0], -0.0)
        for block in range(blocks):
            first = np.uint64(block * width)
            for k in range(np.uint64(8 * width)):
                sums[k] = zero
            for k in range(np.uint64(3 * width)):
                counts[k] = 0
            for j in range(np.uint64(n)):
                xj, yj, ux, uy = now[0, j], now[1, j], now[2, j], now[3, j]
                for lane in range(np.uint64(width)):
                    dx = _nearest_image(xj - now[0, first + lane], size, inverse)
                    dy = _nearest_image(yj - now[1, first + lane], size, inverse)
                    square = dx * dx + dy * dy
                    seen = square > like(square, 1e-30)  # the agent itself is not
                    share = -one / square if seen & (square < apart) else zero
                    with_me, by_me = seen & (square < agree), seen & (square < near)
                    sums[at[0] + lane] += dx * share
                    sums[at[1] + lane] += dy * share
                    sums[at[2] + lane] += ux if with_me else none
                    sums[at[3] + lane] += uy if with_me else none
                    counts[at[0] + lane] += up if with_me else stay
                    sums[at[5] + lane] += dx if by_me else none
                    sums[at[6] + lane] += dy if by_me else none
                    counts[at[1] + lane] += up if by_me else stay
                    counts[at[2] + lane] += up if seen else stay
            add_coincident(now, sums, counts, number, n, first, True, p)
            for lane in range(np.uint64(width)):
                i = first + lane
                has_mates = counts[at[0] + lane] > 0
                mates = one / like(one, counts[at[0] + lane]) if has_mates else zero
                many = counts[at[1] + lane]
                company = one / like(one, many) if many > 0 else zero
                agree_x = sums[at[2] + lane] * mates - now[2, i] if has_mates else zero
                agree_y = sums[at[3] + lane] * mates - now[3, i] if has_mates else zero
                now[4, i] = w_apart * sums[at[0] + lane] + w_agree * agree_x + w_near * (sums[at[5] + lane] * company)
                now[5, i] = w_apart * sums[at[1] + lane] + w_agree * agree_y + w_near * (sums[at[6] + lane] * company)

    return neighbour_force


def _two(width):
    """Return a kernel for separation and cohesion."""
    at, add_coincident = _rows(width), _add_coincident(width)

    @njit(**PARTS)
    def neighbour_force(now, sums, counts, number, n, blocks, p):
        size, apart, near, w_apart, w_near = p[0], p[1], p[3], p[4], p[6]
        zero, one, inverse = like(size, 0.0), like(size, 1.0), like(size, 1.0) / size
        none, up, stay = like(size, -0.0), like(counts[0], 1.0), like(counts[0], -0.0)
        for block in range(blocks):
            first = np.uint64(block * width)
            for k in range(np.uint64(5 * width)):
                sums[k] = zero
            for k in range(np.uint64(3 * width)):
                counts[k] = 0
            for j in range(np.uint64(n)):
                xj, yj = now[0, j], now[1, j]
                for lane in range(np.uint64(width)):
                    dx = _nearest_image(xj - now[0, first + lane], size, inverse)
                    dy = _nearest_image(yj - now[1, first + lane], size, inverse)
                    square = dx * dx + dy * dy
                    seen = square > like(square, 1e-30)  # the agent itself is not
                    share = -one / square if seen & (square < apart) else zero
                    by_me = seen & (square < near)
                    sums[at[0] + lane] += dx * share
                    sums[at[1] + lane] += dy * share
                    sums[at[2] + lane] += dx if by_me else none
                    sums[at[3] + lane] += dy if by_me else none
                    counts[at[1] + lane] += up if by_me else stay
                    counts[at[2] + lane] += up if seen else stay
            add_coincident(now, sums, counts, number, n, first, False, p)
            for lane in range(np.uint64(width)):
                i = first + lane
                many = counts[at[1] + lane]
                company = one / like(one, many) if many > 0 else zero
                now[4, i] = w_apart * sums[at[0] + lane] + w_near * (sums[at[2] + lane] * company)
                now[5, i] = w_apart * sums[at[1] + lane] + w_near * (sums[at[3] + lane] * company)

    return neighbour_force


def _field_of_view(width):
    """Return a kernel for separation, alignment and cohesion of neighbours in a field of view."""
    at, add_coincident = _rows(width), _add_coincident(width)

    @njit(**PARTS)
    def neighbour_force(now, sums, counts, number, n, blocks, p):
        size, apart, agree, near, w_apart, w_agree, w_near, view = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7]
        zero, one, inverse = like(size, 0.0), like(size, 1.0), like(size, 1.0) / size
        none, up, stay = like(size, -0.0), like(counts[0], 1.0), like(counts[0], -0.0)
        for block in range(blocks):
            first = np.uint64(block * width)
            for k in range(np.uint64(8 * width)):
                sums[k] = zero
            for k in range(np.uint64(3 * width)):
                counts[k] = 0
            for lane in range(np.uint64(width)):
                speed = np.sqrt(
                    now[2, first + lane] * now[2, first + lane] + now[3, first + lane] * now[3, first + lane]
                )
                share = one / speed if speed > zero else zero
                sums[at[8] + lane], sums[at[9] + lane] = now[2, first + lane] * share, now[3, first + lane] * share
            for j in range(np.uint64(n)):
                xj, yj, ux, uy = now[0, j], now[1, j], now[2, j], now[3, j]
                for lane in range(np.uint64(width)):
                    dx = _nearest_image(xj - now[0, first + lane], size, inverse)
                    dy = _nearest_image(yj - now[1, first + lane], size, inverse)
                    square = dx * dx + dy * dy
                    ahead = dx * sums[at[8] + lane] + dy * sums[at[9] + lane]
                    still = sums[at[8] + lane] * sums[at[8] + lane] + sums[at[9] + lane] * sums[at[9] + lane] <= zero
                    alone = square > like(square, 1e-30)
                    seen = alone & ((ahead * abs(ahead) >= view * square) | still)
                    share = -one / square if seen & (square < apart) else zero
                    with_me, by_me = seen & (square < agree), seen & (square < near)
                    sums[at[0] + lane] += dx * share
                    sums[at[1] + lane] += dy * share
                    sums[at[2] + lane] += ux if with_me else none
                    sums[at[3] + lane] += uy if with_me else none
                    counts[at[0] + lane] += up if with_me else stay
                    sums[at[5] + lane] += dx if by_me else none
                    sums[at[6] + lane] += dy if by_me else none
                    counts[at[1] + lane] += up if by_me else stay
                    counts[at[2] + lane] += up if alone else stay
            add_coincident(now, sums, counts, number, n, first, True, p)
            for lane in range(np.uint64(width)):
                i = first + lane
                has_mates = counts[at[0] + lane] > 0
                mates = one / like(one, counts[at[0] + lane]) if has_mates else zero
                many = counts[at[1] + lane]
                company = one / like(one, many) if many > 0 else zero
                agree_x = sums[at[2] + lane] * mates - now[2, i] if has_mates else zero
                agree_y = sums[at[3] + lane] * mates - now[3, i] if has_mates else zero
                now[4, i] = w_apart * sums[at[0] + lane] + w_agree * agree_x + w_near * (sums[at[5] + lane] * company)
                now[5, i] = w_apart * sums[at[1] + lane] + w_agree * agree_y + w_near * (sums[at[6] + lane] * company)

    return neighbour_force


# --- all worlds -----------------------------------------------------------------------------------------------------

MIXES: dict[str, Callable[[int], Any]] = {"three": _three, "two": _two, "seeing": _field_of_view}


@functools.cache
def _kernel(mix: str, width: int) -> Any:
    """Return the compiled step of a mix."""
    neighbour_force, move = MIXES[mix](width), _move(width)

    @njit(pipeline_class=Whole, **FAST)
    def step(x, v, alive, drive, body, work, p, dt, steps, now, requested, sums, counts, number):
        unaliased()
        n = x.shape[2]
        blocks = (n + width - 1) // width
        for b in range(x.shape[1]):
            for i in range(np.uint64(n)):
                requested[0, i] = drive[0, b, i] if drive.shape[1] > 0 else like(dt, 0.0)
                requested[1, i] = drive[1, b, i] if drive.shape[1] > 0 else like(dt, 0.0)
            _load(now, x, v, alive, b, n)
            for _ in range(steps):
                neighbour_force(now, sums, counts, number, n, blocks, p)
                if not move(now, requested, body, blocks, p[0], dt):
                    return b
                work[b, 0] += 1
                work[b, 2] += n * n
            _store(now, x, v, b, n)
        return -1

    return step


def by_hand(mix: str, scene: Scene, state: State, steps: int) -> Callable[[], object]:
    """Return a call that advances the arrays of `state` by a number of steps; the scene must be of that mix.

    Its parameters: size, the squares of the radii, the weights, and cos(fov / 2) |cos(fov / 2)|.
    """
    real, width = np.dtype(scene.dtype), WIDTH
    padded = -(-scene.agents // width) * width
    rules = {effect.kind: effect for effect in scene.effects}
    found = [rules.get(kind) for kind in ("separation", "alignment", "cohesion")]
    cosine = math.cos(math.radians(scene.effects[0].sight.fov) / 2)
    numbers = [scene.space.extent(2)[0], *(r.radius**2 if r else 0 for r in found)]
    numbers += [*(r.weight if r else 0 for r in found), cosine * abs(cosine)]
    body = zeros((3, padded), real)
    body[...] = 1
    body[:, : scene.agents] = scene.body.mass, scene.body.max_speed, scene.body.max_force
    now, requested, sums = (zeros(shape, real) for shape in ((ROWS, padded), (2, padded), (10 * width,)))
    now[7:, : scene.agents] = separation_directions(scene.agents, 2).T
    counts = zeros(3 * width, real if REGISTER == LINE else f"i{real.itemsize}")
    arguments = (
        state.x, state.v, state.alive, np.zeros((2, 0, 0), real), body, state.work, np.array(numbers, real),
        real.type(scene.dt), steps, now, requested, sums, counts,
        np.arange(width, dtype=np.int32),
    )  # fmt: skip
    kernel = _kernel(mix, width)
    return lambda: kernel(*arguments)
