"""Hard cases of several agents: all at one place, opposite headings, around the edge of a torus."""

from __future__ import annotations

import numpy as np

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.geometry.space import Torus
from flockenv.physics.integrators import Adaptive, Integrator
from flockenv.scene import Group, Scene
from flockenv.studies.stress.setup import start_with
from flockenv.studies.trial_log import Case, Value

__all__ = ["CROWDS"]

EDGE = 40.0


def flock(method: Integrator, count: int, together: float = 1.0, dt: float = 0.02) -> Scene:
    """Return boids on a torus: one set of laws for all cases of this file."""
    rules = (
        Separation(weight=1.0, radius=2.0), Alignment(weight=0.2 * together, radius=3.0),
        Cohesion(weight=0.1 * together, radius=3.0),
    )  # fmt: skip
    return Scene(space=Torus(size=(EDGE, EDGE)), groups=(Group(count=count),), effects=rules, integrator=method, dt=dt)


def in_one_place(method: Integrator) -> Value:
    """Start 50 agents in one place and 2 in another, at rest: they must part within 1 s and conserve momentum."""
    scene = flock(method, 52, together=0.0)  # separation alone conserves momentum
    pos = np.full((52, 2), 10.0)
    pos[50:] = 30.0, 20.0
    end = scene.run(start_with(scene, pos, np.zeros((52, 2))), 50)
    momentum = float(np.abs(end.vel[0].sum(axis=0)).max())
    gaps = np.linalg.norm(scene.space.displacement(end.pos[0, :, None], end.pos[0, None]), axis=2)
    least = float(gaps[~np.eye(52, dtype=bool)].min())
    bound = 1e-4 if method.solves else 1e-10  # equations are solved to a tolerance, agent by agent
    return Value(least, least > 0.01 and momentum <= bound, f"least gap {least:.3g} m, momentum {momentum:.1g}")


def at_rest_and_alone(method: Integrator) -> Value:
    """Check two agents with opposite headings, and one alone at rest, for NaN and for forces along +x (N10)."""
    scene = flock(method, 3)
    start = start_with(scene, [(10, 10), (11, 10), (30, 30)], [(0, 1.0), (0, -1.0), (0, 0)])
    end = scene.run(start, 50)
    lone = float(np.abs(end.vel[0, 2]).max())
    drift = float(np.abs(end.vel[0, :2].sum(axis=0)).max())
    return Value(max(lone, drift), lone == 0.0 and drift <= 1e-9, f"alone {lone:.1g} m/s, pair drifts {drift:.1g} m/s")


def seam(method: Integrator) -> Value:
    """Compare a pair across the edge with one in the middle; all agents must stay in [0, L), also one at -1e-17."""
    scene, rng = flock(method, 12), np.random.default_rng(0)
    pos, vel = rng.uniform(15, 25, (12, 2)), rng.normal(size=(12, 2))
    one = scene.run(start_with(scene, pos, vel), 60)
    worst, inside = 0.0, True
    for shift in ((20.0, 0.0), (-20.0, 20.0), (17.3, -22.9)):
        moved = (pos + shift) % EDGE
        other = scene.run(start_with(scene, moved, vel), 60)
        apart = scene.space.displacement(one.pos[0] + shift, other.pos[0])
        worst = max(worst, float(np.abs(apart).max()))
        inside &= bool(((other.pos >= 0) & (other.pos < EDGE)).all())
    alone = flock(method, 1)
    end = alone.step(start_with(alone, [(-1e-17, EDGE)], [(0.0, 0.0)]))
    inside &= bool(((end.pos >= 0) & (end.pos < EDGE)).all())
    bound = method.tolerance if isinstance(method, Adaptive) else 1e-9  # the step taken depends on rounding
    return Value(worst, worst <= bound and inside, f"{worst:.1g} m apart; inside: {inside}")


CROWDS = (
    Case("N09 crowd", "50 agents in one place", "apart within 1 s, momentum 1e-10", in_one_place),
    Case("N10", "opposite headings; alone at rest", "no drift, no NaN", at_rest_and_alone),
    Case("N18", "pairs across the seam of a torus", "1e-9 m (steps of its own: tolerance), inside", seam),
)
