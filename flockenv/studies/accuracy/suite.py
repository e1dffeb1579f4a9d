"""The suite of benchmark problems: some with closed forms, and flocks, with smooth and non-smooth forces.

Those of solids and liquids are in `solids`, those of contacts with faces in `faces`.

Durations are not integer multiples of periods, at which semi-implicit Euler would seem to have order 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.core.errors import nearest, printable
from flockenv.geometry.shapes import HalfSpace
from flockenv.geometry.space import Torus
from flockenv.model.networks import Rope
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions, Rods
from flockenv.physics.effects import (
    Attraction,
    Carried,
    Drag,
    Effect,
    Gravity,
    QuadraticDrag,
    Swing,
    Tether,
    Uniform,
    Vortex,
)
from flockenv.scene import Group, Scene
from flockenv.studies.accuracy.faces import slope, trampoline
from flockenv.studies.accuracy.paths import Floats
from flockenv.studies.accuracy.problem import Exact, Problem
from flockenv.studies.accuracy.solids import altitudes, bar, block, breaking, drop, jelly, sheet, yielding

__all__ = ["SUITE", "select_problems"]

ORIGIN = (0.0, 0.0)
BIRDS, EDGE, REACH = 24, 40.0, 20.0
"""Flocks: number of agents, edge of the torus, m, and radius of sight, m, which is larger than the flock."""


def powers(first: int, last: int) -> tuple[int, ...]:
    """Return 2^first ... 2^last."""
    return tuple(2**k for k in range(first, last + 1))


def _one_body(
    name: str, title: str, effects: Sequence[Effect], seconds: float, steps: Sequence[int], exact: Exact | None,
    start: tuple[Floats, Floats] | None = None,
) -> Problem:  # fmt: skip
    """Return the problem of one body of 1 kg that begins at its closed form for t = 0, or at `start`."""
    group = Group(count=1, spawn=Spawn(low=ORIGIN, high=ORIGIN))
    scene = Scene(groups=(group,), effects=tuple(effects))
    motion = exact(0.0) if start is None and exact is not None else start
    return Problem.of(scene, seconds, steps, name=name, title=title, motion=motion, exact=exact)


def _rows(*row: float) -> Floats:
    return np.array([row])


# --- oscillators ------------------------------------------------------------------------------------------------------


def oscillator() -> Problem:
    """Return the oscillator x'' = -x, from rest at 1 m."""

    def exact(t: float) -> tuple[Floats, Floats]:
        return _rows(math.cos(t), 0.0), _rows(-math.sin(t), 0.0)

    spring = Tether(centre=ORIGIN, stiffness=1.0)
    return _one_body("oscillator", "Oscillator, 9.7 periods", [spring], 9.7 * 2 * math.pi, powers(6, 15), exact)


def damped_oscillator() -> Problem:
    """Return the oscillator x'' = -w^2 x - 2 zeta w x', w = 2 1/s, zeta = 0.1, from (1 m, 0.3 m/s)."""
    w, zeta, x0, v0 = 2.0, 0.1, 1.0, 0.3

    def exact(t: float) -> tuple[Floats, Floats]:
        decay, wd = math.exp(-zeta * w * t), w * math.sqrt(1 - zeta**2)
        a, b = x0, (v0 + zeta * w * x0) / wd
        x = decay * (a * math.cos(wd * t) + b * math.sin(wd * t))
        v = -zeta * w * x + decay * wd * (b * math.cos(wd * t) - a * math.sin(wd * t))
        return _rows(x, 0.0), _rows(v, 0.0)

    spring = Tether(centre=ORIGIN, stiffness=w * w, damping=2 * zeta * w)
    return _one_body("damped", "Damped oscillator, 0.7 periods", [spring], 0.7 * 2 * math.pi / w, powers(3, 11), exact)


def pendulum() -> Problem:
    """Return a pendulum, angle'' = -(2 pi)^2 sin(angle), from rest at 120 degrees, for 5 periods of a small swing."""
    swing = Swing(centre=ORIGIN, strength=4 * math.pi**2)
    start = _rows(2 * math.pi / 3, 0.0), _rows(0.0, 0.0)
    return _one_body("pendulum", "Pendulum from 120\u00b0", [swing], 5.0, powers(7, 17), None, start)


def forced_oscillator() -> Problem:
    """Return the oscillator x'' = -x + cos 2t, from rest at 0: its force also varies within a step."""

    def exact(t: float) -> tuple[Floats, Floats]:
        x, v = (math.cos(t) - math.cos(2 * t)) / 3, (2 * math.sin(2 * t) - math.sin(t)) / 3
        return _rows(x, 0.0), _rows(v, 0.0)

    effects = (Tether(centre=ORIGIN, stiffness=1.0), Uniform(strength=(1.0, 0.0), period=math.pi))
    return _one_body("forced", "Oscillator forced by cos 2t", effects, 0.7 * 2 * math.pi, powers(4, 12), exact)


# --- orbits -----------------------------------------------------------------------------------------------------------


def _kepler(name: str, eccentricity: float, periods: float, steps: Sequence[int]) -> Problem:
    """Return a body in orbit about a fixed sun, mu = 1 and a = 1, from its pericentre."""

    def exact(t: float) -> tuple[Floats, Floats]:
        angle, e = t, eccentricity  # the eccentric anomaly solves t = E - e sin E
        for _ in range(60):
            angle -= (angle - e * math.sin(angle) - t) / (1 - e * math.cos(angle))
        flat, rate = math.sqrt(1 - e * e), 1 / (1 - e * math.cos(angle))
        pos = _rows(math.cos(angle) - e, flat * math.sin(angle))
        return pos, _rows(-math.sin(angle) * rate, flat * math.cos(angle) * rate)

    sun = Attraction(centre=ORIGIN, strength=1.0)
    title = f"Kepler orbit, e = {eccentricity:g}, {periods:g} periods"
    return _one_body(name, title, [sun], periods * 2 * math.pi, steps, exact)


def kepler() -> Problem:
    """Return an orbit of moderate eccentricity."""
    return _kepler("kepler", 0.5, 3.3, powers(7, 17))


def kepler_close() -> Problem:
    """Return an orbit that passes close to the sun; short steps are needed only there."""
    return _kepler("kepler_close", 0.9, 1.3, powers(8, 18))


# --- drag and media ---------------------------------------------------------------------------------------------------

GRAVITY = 9.81


def projectile() -> Problem:
    """Return a throw of (10, 15) m/s with linear drag."""
    rate, vx, vy = 0.2, 10.0, 15.0

    def exact(t: float) -> tuple[Floats, Floats]:
        left, fall = math.exp(-rate * t), GRAVITY / rate
        pos = _rows(vx * (1 - left) / rate, (vy + fall) * (1 - left) / rate - fall * t)
        return pos, _rows(vx * left, (vy + fall) * left - fall)

    effects = (Gravity(acceleration=(0.0, -GRAVITY)), Drag(rate=rate))
    return _one_body("projectile", "Throw with linear drag", effects, 2.5, powers(3, 11), exact)


def quadratic_fall() -> Problem:
    """Return a fall from rest with quadratic drag; the speed tends to 20 m/s."""
    limit = 20.0

    def exact(t: float) -> tuple[Floats, Floats]:
        fallen = limit**2 / GRAVITY * math.log(math.cosh(GRAVITY * t / limit))
        return _rows(0.0, -fallen), _rows(0.0, -limit * math.tanh(GRAVITY * t / limit))

    effects = (Gravity(acceleration=(0.0, -GRAVITY)), QuadraticDrag(rate=GRAVITY / limit**2))
    return _one_body("quadratic_fall", "Fall with quadratic drag", effects, 3.0, powers(3, 11), exact)


def tracer() -> Problem:
    """Return a particle that a vortex carries around in circles, once in 6.94 s."""
    flow, most, radius = 2.0, 5.0, 1.2
    turn = flow / (flow / most + radius**2) / radius

    def exact(t: float) -> tuple[Floats, Floats]:
        return _rows(radius * math.cos(turn * t), radius * math.sin(turn * t)), _rows(0.0, 0.0)

    effects = (Vortex(centre=ORIGIN, strength=flow, maximum=most, acts="medium"), Carried())
    return _one_body("tracer", "Tracer in a vortex, 1.7 turns", effects, 1.7 * 2 * math.pi / turn, powers(5, 16), exact)


# --- impacts and rods -------------------------------------------------------------------------------------------------


def bounces() -> Problem:
    """Return a ball of 0.1 m that falls from 1 m and bounces, e = 0.8: impacts at 0.428, 1.114, 1.662, 2.101 s, ..."""
    drop, elastic, radius = 0.9, 0.8, 0.1

    def exact(t: float) -> tuple[Floats, Floats]:
        left, up = t - math.sqrt(2 * drop / GRAVITY), math.sqrt(2 * drop * GRAVITY)
        if left < 0:
            return _rows(0.0, radius + drop - GRAVITY * t * t / 2), _rows(0.0, -GRAVITY * t)
        up *= elastic
        while left > 2 * up / GRAVITY:
            left, up = left - 2 * up / GRAVITY, elastic * up
        return _rows(0.0, radius + up * left - GRAVITY * left * left / 2), _rows(0.0, up - GRAVITY * left)

    scene = Scene(
        groups=(Group(count=1, radius=radius, spawn=Spawn(low=(0, 1), high=(0, 1))),), effects=(Gravity(),),
        obstacles=(HalfSpace(point=ORIGIN, direction=(0.0, 1.0)),), constraints=(Collisions(restitution=elastic),),
    )  # fmt: skip
    return Problem.of(
        scene, 1.9, powers(4, 12), name="bounces", title="Ball on a floor, 3 impacts", motion=exact(0.0), exact=exact
    )


def rod() -> Problem:
    """Return a bob on a rod of 1 m, released level: sin(angle / 2) = k cd(w t, k), k = sin 45 degrees, w^2 = g / l."""
    w, k = math.sqrt(GRAVITY), math.sqrt(0.5)

    def exact(t: float) -> tuple[Floats, Floats]:
        from scipy.special import ellipj

        sn, cn, dn, _ = ellipj(w * t, k * k)
        angle, rate = 2 * math.asin(k * cn / dn), -2 * k * math.sqrt(1 - k * k) * w * sn / dn
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[0.0, 0.0], [s, -c]]), np.array([[0.0, 0.0], [c * rate, s * rate]])

    rope = Rope(links=1, start=ORIGIN, end=(1.0, 0.0), pinned=("start",))
    scene = Scene(groups=(Group(network=rope),), effects=(Gravity(),), constraints=(Rods(group=0),))
    title = "Pendulum on a rod, 1.3 periods"
    return Problem.of(scene, 3.1, powers(6, 14), name="rod", title=title, motion=exact(0.0), exact=exact)


# --- flocks -----------------------------------------------------------------------------------------------------------


def _flock(name: str, title: str, fov: float = 360.0, max_speed: float | None = None) -> Problem:
    """Return the problem of a flock that stays together in the middle of a torus."""
    low, high = (0.4 * EDGE,) * 2, (0.6 * EDGE,) * 2
    group = Group(count=BIRDS, max_speed=max_speed, spawn=Spawn(low=low, high=high, speed=(0.5, 1.5)))
    rules = (
        Separation(weight=1.0, radius=REACH),
        Alignment(weight=0.6, radius=REACH, fov=fov),
        Cohesion(weight=0.4, radius=REACH, fov=fov),
    )
    scene = Scene(space=Torus(size=(EDGE, EDGE)), groups=(group,), effects=rules)
    return Problem.of(scene, 2.0, powers(4, 12), name=name, title=title)


def boids() -> Problem:
    """Return boids with a view of 360 degrees: forces are smooth as long as each agent sees all others."""
    return _flock("boids", f"{BIRDS} boids that see all around")


def boids_cone() -> Problem:
    """Return boids with a view cone: forces jump if a neighbour enters or leaves it."""
    return _flock("boids_cone", f"{BIRDS} boids that see 270\u00b0", fov=270.0)


def boids_limit() -> Problem:
    """Return boids with a speed limit, which is enforced after each step."""
    return _flock("boids_limit", f"{BIRDS} boids with a speed limit", max_speed=1.5)


SUITE: dict[str, Callable[[], Problem]] = {
    "oscillator": oscillator,
    "damped": damped_oscillator,
    "forced": forced_oscillator,
    "pendulum": pendulum,
    "kepler": kepler,
    "kepler_close": kepler_close,
    "projectile": projectile,
    "quadratic_fall": quadratic_fall,
    "tracer": tracer,
    "bounces": bounces,
    "rod": rod,
    "bar": bar,
    "sheet": sheet,
    "jelly": jelly,
    "altitudes": altitudes,
    "yielding": yielding,
    "breaking": breaking,
    "block": block,
    "drop": drop,
    "slope": slope,
    "trampoline": trampoline,
    "boids": boids,
    "boids_cone": boids_cone,
    "boids_limit": boids_limit,
}
"""Every problem by its name, in the order in which they are shown."""


def select_problems(names: Sequence[str] = ()) -> list[Problem]:
    """Return problems by name (no names: all); raise ValueError, with the nearest name, for an unknown one."""
    for name in names:
        if name not in SUITE:
            raise ValueError(f"problems: {printable(name)}: unknown{nearest(name, SUITE)} ({', '.join(SUITE)})")
    return [SUITE[name]() for name in (dict.fromkeys(names) or SUITE)]
