"""The suite: problems with closed forms, and flocks, that show what methods cost where forces are smooth and where not.

Horizons are no whole numbers of periods: there semi-implicit Euler would pass for a method of order 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from flockenv.accuracy.problem import Exact, Floats, Problem
from flockenv.effects import Alignment, Cohesion, Effect, Separation, Swing, Tether
from flockenv.refusals import nearest, shown
from flockenv.scene import Group, Scene
from flockenv.space import Torus
from flockenv.spawn import Spawn

__all__ = ["SUITE", "problems_named"]

ORIGIN = (0.0, 0.0)
BIRDS, EDGE, REACH = 24, 40.0, 20.0
"""Of the flocks: how many, on a torus of which edge, m, who see how far, m: everybody, as long as they are together."""


def powers(first: int, last: int) -> tuple[int, ...]:
    """Return 2^first ... 2^last."""
    return tuple(2**k for k in range(first, last + 1))


def _one_body(
    name: str, title: str, effects: Sequence[Effect], seconds: float, steps: Sequence[int], exact: Exact | None,
    start: tuple[Floats, Floats] | None = None,
) -> Problem:  # fmt: skip
    """Return the problem of one body of 1 kg that begins where its closed form says, or at `start`."""
    group = Group(count=1, spawn=Spawn(low=ORIGIN, high=ORIGIN))
    scene = Scene(groups=(group,), effects=tuple(effects))
    motion = exact(0.0) if start is None and exact is not None else start
    return Problem.of(scene, seconds, steps, name=name, title=title, motion=motion, exact=exact)


def _rows(*row: float) -> Floats:
    return np.array([row])


# --- oscillators ------------------------------------------------------------------------------------------------------


def oscillator() -> Problem:
    """x'' = -x from rest at 1 m."""

    def exact(t: float) -> tuple[Floats, Floats]:
        return _rows(math.cos(t), 0.0), _rows(-math.sin(t), 0.0)

    spring = Tether(centre=ORIGIN, stiffness=1.0)
    return _one_body("oscillator", "Oscillator, 9.7 periods", [spring], 9.7 * 2 * math.pi, powers(6, 15), exact)


def damped_oscillator() -> Problem:
    """x'' = -w^2 x - 2 zeta w x', w = 2 1/s, zeta = 0.1, from (1 m, 0.3 m/s)."""
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
    """angle'' = -(2 pi)^2 sin(angle) from rest at 120 degrees, 5 s: five times as long as a small swing takes."""
    swing = Swing(centre=ORIGIN, strength=4 * math.pi**2)
    start = _rows(2 * math.pi / 3, 0.0), _rows(0.0, 0.0)
    return _one_body("pendulum", "Pendulum from 120\u00b0", [swing], 5.0, powers(7, 17), None, start)


# --- flocks -----------------------------------------------------------------------------------------------------------


def _flock(name: str, title: str, fov: float = 360.0, max_speed: float | None = None) -> Problem:
    """Return the problem of a flock in the middle of a torus, which stays together."""
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
    """Three rules, eyes all around: a smooth force as long as everybody sees everybody."""
    return _flock("boids", f"{BIRDS} boids that see all around")


def boids_cone() -> Problem:
    """The same with a view cone: forces jump whenever somebody enters or leaves it."""
    return _flock("boids_cone", f"{BIRDS} boids that see 270\u00b0", fov=270.0)


def boids_limit() -> Problem:
    """The same with a speed limit, which is kept to after each step."""
    return _flock("boids_limit", f"{BIRDS} boids with a speed limit", max_speed=1.5)


SUITE: dict[str, Callable[[], Problem]] = {
    "oscillator": oscillator,
    "damped": damped_oscillator,
    "pendulum": pendulum,
    "boids": boids,
    "boids_cone": boids_cone,
    "boids_limit": boids_limit,
}
"""Every problem by its name, in the order in which they are shown."""


def problems_named(names: Sequence[str] = ()) -> list[Problem]:
    """Return problems by name, none = all; raises ValueError, with the nearest, for a name that is not there."""
    for name in names:
        if name not in SUITE:
            raise ValueError(f"problems: {shown(name)} is none{nearest(name, SUITE)} ({', '.join(SUITE)})")
    return [SUITE[name]() for name in (dict.fromkeys(names) or SUITE)]
