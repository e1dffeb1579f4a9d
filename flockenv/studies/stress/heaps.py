"""Hard cases of discs at rest: an incline, a stack of ten, a thousand in a funnel."""

from __future__ import annotations

import itertools
import math

import numpy as np

from flockenv.geometry.shapes import HalfSpace, Wall
from flockenv.physics.integrators import Integrator
from flockenv.studies.stress.solids import Floats, G, Response, batch, cases_by_response, disc_scene, overlap
from flockenv.studies.trial_log import Value

__all__ = ["HEAPS", "funnel"]

R = 0.1
FLOOR = HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0))

# --- N23: a funnel ----------------------------------------------------------------------------------------------------

GRAIN = 0.04  # m, the radius of a disc
GATE = 2.5 * GRAIN  # m, half the opening
SIDES = (
    Wall(vertices=((-2.0, 8.0), (-2.0, 2.6), (-GATE, 1.0), (-GATE, 0.8)), radius=0.02),
    Wall(vertices=((2.0, 8.0), (2.0, 2.6), (GATE, 1.0), (GATE, 0.8)), radius=0.02),
)  # fmt: skip
ROOM = (
    *SIDES, HalfSpace(point=(0.0, 0.0), direction=(0.0, 1.0)),
    HalfSpace(point=(-2.5, 0.0), direction=(1.0, 0.0)), HalfSpace(point=(2.5, 0.0), direction=(-1.0, 0.0)),
)  # fmt: skip
INFLOW = 15.0  # s, after which no disc is added, and energy may not grow


def funnel(method: Integrator, response: Response, seconds: float = 60.0, count: int = 1000) -> Value:
    """Drop discs through a funnel; measure overlap, discs that cross a wall, and energy growth after the inflow."""
    dt = 1 / 480
    scene = disc_scene(
        method, response, dt, count=count, radius=GRAIN, pull=(0.0, -G), obstacles=ROOM, restitution=0.2, friction=0.3,
        passes=60,
    )  # fmt: skip
    state = batch(scene, _lattice(count), 0.0)
    deep, lost, passed, energies, before = 0.0, False, 0, [], state.pos[0]
    for k in range(round(seconds / dt)):
        state = scene.step(state, out=state)
        if k % 6 == 5:
            pos = state.pos[0].copy()
            walls = min(float(shape.gap(pos).min()) for shape in ROOM)
            deep = max(deep, overlap(pos, GRAIN), GRAIN - walls)
            lost |= _has_left(before, pos)
            before = pos
        if k % 480 == 479:
            energies.append(float((0.5 * (state.vel[0] ** 2).sum(axis=1) + G * state.pos[0, :, 1]).sum()))
    passed = int((state.pos[0, :, 1] < 0.8).sum())
    late = np.diff(energies[min(round(INFLOW), len(energies) // 2) :])
    grows = float(late.max(initial=0.0)) / (count * G * GRAIN)
    note = (
        f"overlap {deep / GRAIN:.2%} of R, left through a wall: {lost}, energy grows by {grows:.1g} m g R a second at "
        f"most, {passed} of {count} through the gate after {seconds:g} s, {float(np.abs(state.vel).max()):.2g} m/s then"
    )
    return Value(deep / GRAIN, deep <= 0.05 * GRAIN and not lost and grows <= 1e-6, note)


def _lattice(count: int) -> Floats:
    """Return starting positions, (count, 2) m: rows of 44 above the funnel, every other one shifted, with jitter."""
    k = np.arange(count)
    row, column = k // 44, k % 44
    off = np.random.default_rng(0).uniform(-0.1, 0.1, (count, 2)) * GRAIN
    x = (column - 21.5 + 0.3 * (row % 2)) * 2.2 * GRAIN
    return np.stack([x, 2.8 + row * 2.2 * GRAIN], axis=1) + off


def _has_left(before: Floats, after: Floats) -> bool:
    """Return True if a disc has crossed the middle of a wall, or a plane, between two instants."""
    out = (np.abs(after[:, 0]) > 2.5) | (after[:, 1] < 0)
    for shape in SIDES:
        corners = np.array(shape.vertices)
        for a, b in itertools.pairwise(corners):
            move = after - before
            crosses = _cross(b - a, before - a) * _cross(b - a, after - a) < 0
            out |= crosses & (_cross(move, a - before) * _cross(move, b - before) < 0)
    return bool(out.any())


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product a x b of vectors of the plane."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


# --- N22: an incline, and how far a body slides -----------------------------------------------------------------------


def incline(method: Integrator, response: Response) -> Value:
    """Check a body on inclines: friction .3 holds at 16.6 degrees, not at 16.8 and 30; .4 stops 3 m/s in 1.14679 m."""
    rests = 6.0 if method.solves else 60.0  # s
    creep = _sliding_distance(method, response, 16.6, rests)
    slow = _sliding_distance(method, response, 16.8, 4.0) / (0.5 * _pull(16.8) * 16.0)
    fast = _sliding_distance(method, response, 30.0, 2.0) / (0.5 * _pull(30.0) * 4.0)
    scene = disc_scene(method, response, 0.005, pull=(0.0, -G), obstacles=(FLOOR,), friction=0.4)
    end = scene.run(batch(scene, [[[0.0, R]]], [[[3.0, 0.0]]]), 400)
    stop, still = float(end.pos[0, 0, 0]), float(np.abs(end.vel[0, 0]).max())
    off = max(abs(stop / 1.1467890 - 1), abs(slow - 1), abs(fast - 1))
    note = (
        f"16.6 degrees: {creep:.1g} m in {rests:g} s; 16.8: {slow:.4f} of the way; 30: {fast:.4f}; stops after "
        f"{stop:.5f} m, then {still:.1g} m/s"
    )
    return Value(off, off <= 0.01 and abs(creep) <= 1e-6 and still <= 1e-9, note)


def _pull(degrees: float, friction: float = 0.3) -> float:
    """Return the acceleration down an incline, m/s^2."""
    return G * (math.sin(math.radians(degrees)) - friction * math.cos(math.radians(degrees)))


def _sliding_distance(method: Integrator, response: Response, degrees: float, seconds: float) -> float:
    """Return the distance that a body slides down an incline from rest, m."""
    angle = math.radians(degrees)
    up = np.array([-math.sin(angle), math.cos(angle)])
    ramp = HalfSpace(point=(0.0, 0.0), direction=(float(up[0]), float(up[1])))
    scene = disc_scene(method, response, 0.01, pull=(0.0, -G), obstacles=(ramp,), friction=0.3)
    end = scene.run(batch(scene, [[R * up]], 0.0), round(seconds / scene.dt))
    return float((end.pos[0, 0] - R * up) @ (-math.cos(angle), -math.sin(angle)))


# --- P19: a stack -----------------------------------------------------------------------------------------------------


def stack(method: Integrator, response: Response) -> Value:
    """Measure the largest displacement of a disc in a stack of ten in 20 s, in radii."""
    scene = disc_scene(method, response, 0.01, count=10, pull=(0.0, -G), obstacles=(FLOOR,), friction=0.3)
    begin = np.stack([np.zeros(10), R * (1 + 2 * np.arange(10))], axis=1)
    state, far = batch(scene, begin[None], 0.0), 0.0
    for _ in range(200):
        state = scene.run(state, 10)
        far = max(far, float(np.linalg.norm(state.pos[0] - begin, axis=1).max()) / R)
    return Value(far, far <= 0.01, f"{far:.2g} R away at most, {np.abs(state.vel).max():.1g} m/s at the end")


HEAPS = (
    *cases_by_response(
        "N22", "incline, friction .3; a stop", "stays at 16.6, slides at 16.8; 1.14679 m +- 1 %", incline,
    ),
    *cases_by_response(
        "N23", "1,000 discs in a funnel for 60 s", "overlap 5 % R, none out, no energy gained", funnel,
        ("impulses",), ("semi_implicit_euler",),
    ),
    *cases_by_response("P19", "a stack of ten for 20 s", "drift 1 % R", stack),
)  # fmt: skip
