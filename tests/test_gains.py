"""Stability limits of behaviours: a scene warns just beyond the linear limit and not just below it."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Alignment, Arrive, Cohesion, MatchVelocity, Pursue, Seek
from flockenv.behaviours.steer import Steer
from flockenv.core.warnings import UnstableStepWarning
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.physics.integrators import VelocityVerlet
from flockenv.scene import Group, Scene
from flockenv.scene.stability import suggest_dt
from flockenv.scene.yaml_io import load_scene
from tests.catalogue import Array

O2 = (0.0, 0.0)
TOP, SLOW = 3.0, 2.0

UNBOUNDED = {
    "avoid_obstacles", "circular_repulsion", "elliptical_repulsion", "force_field", "friends", "interest",
    "obstacle_repulsion", "separation", "sidestep", "unaligned_avoidance", "whiskers",
}  # fmt: skip
"""Behaviours whose force is no gain times a velocity or an offset: of constant size, or steeper for nearer agents."""

EXCEEDED = {"follow_path": 1.25, "orca": 1.05}
"""By how much the damping of some behaviours exceeds their bound, which is known to be too low."""


def scene(*effects: Effect, dt: float = 1e-3, count: int = 1, speed: float = 1.0, **group: Any) -> Scene:
    given = {"max_speed": TOP, "spawn": Spawn(low=O2, high=(5.0, 5.0), speed=(speed, speed))} | group
    return Scene(groups=(Group(count=count, **given),), effects=effects, dt=dt)


def semi_implicit(square: float, damping: float) -> float:
    """Return the largest stable step of semi-implicit Euler: h^2 k + 2 h c = 4."""
    if square == 0:
        return 2 / damping
    return (math.sqrt(damping**2 + 4 * square) - damping) / square


BEHAVIOURS = sorted(k for k, e in EFFECTS.items() if e.steering and "weight" in e.model_fields and e.demo)


def alone(kind: str) -> Scene:
    """Return the scene of a behaviour's demo without other behaviours and without force limits."""
    shown, effects = load_scene(str(EFFECTS[kind].demo)), []
    for effect in shown.effects:
        left = tuple(each for each in effect.components if each.kind == kind)
        if left:
            effects.append(Steer(group=effect.group, behaviours=left, arbitration={"kind": "blend"}))  # type: ignore[attr-defined, arg-type]
        elif effect.kind == kind or (not effect.steering and effect.rates(shown.groups, shown.dimension) is None):
            effects.append(effect)
    groups = tuple(g if g.max_force == 0 else g.model_copy(update={"max_force": None}) for g in shown.groups)
    return shown.model_copy(update={"effects": tuple(effects), "groups": groups, "dt": 1e-3})


def derivative(of: Scene, state: State, agent: int, name: str) -> Array:
    """Return - d a / d x or - d a / d v of one agent with respect to its own x or v, (D, D), by differences."""
    columns = []
    for k in range(of.dimension):
        ends = []
        for sign in (1, -1):
            moved = state.copy()
            getattr(moved, name)[k, 0, agent] += sign * 1e-6
            ends.append(of.acceleration(moved)[0, agent])
        columns.append((ends[1] - ends[0]) / 2e-6)
    return np.array(columns).T


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in BEHAVIOURS if kind not in UNBOUNDED])
def test_damping_stays_below_its_bound_and_reaches_about_half_of_it(kind: str) -> None:
    """Damping is measured by differences of the compiled law along a run of the demo.

    The bounds of follow_path and orca leave out that what an agent heads for moves with its velocity: in these runs
    they are exceeded by 22 and 4.4 %, and by less than 5 % if the behaviour is alone. Cohesion has no damping, heads in
    a walking group turn less far than they could, and agents that evade have no pursuer near in this scene.
    """
    shares = shares_of_the_bound(load_scene(str(EFFECTS[kind].demo)), alone(kind))  # test_gallery.py compiles its step
    assert max(shares) <= EXCEEDED.get(kind, 1.0001)
    assert max(shares) > 0.45 or kind in ("cohesion", "evade", "walking_group")
    if kind in EXCEEDED:
        assert max(shares_of_the_bound(alone(kind), alone(kind))) <= 1.05


def shares_of_the_bound(runs: Scene, only: Scene) -> list[float]:
    """Return damping over its bound of each agent of a behaviour alone, in four states along a run of 2.8 s."""
    state, shares = runs.start(0), []
    bounds = [each for effect in only.effects if effect.steering if (each := effect.rates(only.groups, only.dimension))]
    most = sum(damping for _, damping in bounds)
    for _ in range(4):
        state = runs.run(state, round(0.7 / runs.dt))
        now = state.with_dt(only.dt)
        for agent in range(only.agents):
            damping = np.linalg.eigvals(derivative(only, now, agent, "v")).real.max()
            assert damping <= 1e-6 or most[agent] > 0
            shares.append(float(damping / most[agent]) if most[agent] > 0 else 0.0)
    return shares


@pytest.mark.parametrize("kind", [kind for kind in BEHAVIOURS if kind not in UNBOUNDED])
def test_every_behaviour_with_a_gain_warns_only_beyond_its_limit(kind: str) -> None:
    """The behaviour is alone in the scene of its demo."""
    only = alone(kind)
    found = suggest_dt(only)
    assert found.effect in (kind, "steer")
    assert 0 < found.dt < math.inf
    assert found.damping > 0 or kind == "cohesion"
    with pytest.warns(UnstableStepWarning, match="is stable"):
        only.model_copy(update={"dt": 1.01 * found.dt})
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnstableStepWarning)
        only.model_copy(update={"dt": 0.99 * found.dt})


def test_only_behaviours_without_a_gain_return_no_rates() -> None:
    for kind in BEHAVIOURS:
        shown = load_scene(str(EFFECTS[kind].demo))
        behaviour = next(b for effect in shown.effects for b in (*effect.components, effect) if b.kind == kind)
        knows = behaviour.rates(shown.groups, shown.dimension) is not None
        assert knows != (kind in UNBOUNDED), kind


@pytest.mark.parametrize(
    ("behaviour", "square", "damping"),
    [
        (Seek(weight=10.0, target=O2), 0.0, 10.0),
        (Arrive(weight=10.0, target=O2, slow_radius=SLOW), 10 * TOP / SLOW, 10.0),
        (Arrive(weight=10.0, target=O2, slow_radius=SLOW, speed=1.0), 10 * 1 / SLOW, 10.0),
        (Alignment(weight=10.0, radius=5.0), 0.0, 20.0),
        (Cohesion(weight=10.0, radius=5.0), 20.0, 0.0),
        (MatchVelocity(weight=10.0, radius=5.0), 0.0, 20.0),
        (Pursue(weight=10.0, radius=5.0), 0.0, 10.0),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_limits_are_those_of_the_linear_law(behaviour: Effect, square: float, damping: float) -> None:
    found = suggest_dt(scene(behaviour))
    assert found.dt == pytest.approx(semi_implicit(square, damping), rel=1e-4)
    assert found.effect == behaviour.kind
    heavy = suggest_dt(scene(behaviour, mass=4.0))
    assert heavy.dt == pytest.approx(semi_implicit(square / 4, damping / 4), rel=1e-4)
    verlet = scene(behaviour).model_copy(update={"integrator": VelocityVerlet()})
    assert 0 < suggest_dt(verlet).dt < math.inf


def test_arrive_oscillates_at_its_target_only_beyond_the_limit() -> None:
    """w = 10 kg/s, m = 1 kg, V = 3 m/s, slow_radius 2 m: .1766 s."""
    limit = semi_implicit(15.0, 10.0)
    assert limit == pytest.approx(0.1766, abs=1e-4)
    behaviour = Arrive(weight=10.0, target=O2, slow_radius=SLOW)
    calm = scene(behaviour, dt=0.95 * limit)
    end = calm.run(calm.start(0), 1000)
    assert np.abs(end.vel).max() < 1e-9
    with pytest.warns(UnstableStepWarning, match="arrive"):
        shaky = scene(behaviour, dt=1.1 * limit)
    end = shaky.run(shaky.start(0), 1000)
    assert np.abs(end.vel).max() > 0.1


@pytest.mark.slow
def test_aligned_velocities_flip_in_every_step_only_beyond_the_limit() -> None:
    """Each of 100 agents sees some others: limits lie between m / w for two agents and 2 m / w for very many."""
    rule = Alignment(weight=10.0, radius=5.0)
    spawn = Spawn(speed=(1.0, 2.0))
    group = Group(count=100, radius=0.1, max_speed=3.0, spawn=spawn)
    space = Torus(size=(50.0, 50.0))
    calm = Scene(space=space, groups=(group,), effects=(rule,), dt=0.095)
    before = calm.run(calm.start(0), 400)
    assert np.abs(calm.step(before).vel - before.vel).max() < 1e-2
    with pytest.warns(UnstableStepWarning, match="alignment"):
        wild = Scene(space=space, groups=(group,), effects=(rule,), dt=0.25)
    before = wild.run(wild.start(0), 400)
    assert np.abs(wild.step(before).vel - before.vel).max() > 3.0


def test_two_agents_that_see_only_each_other_set_the_limit_of_alignment() -> None:
    rule = Alignment(weight=10.0, radius=50.0)
    for dt, grows in ((0.098, False), (0.102, True)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnstableStepWarning)
            two = scene(rule, dt=dt, count=2, max_speed=None)
        start = two.start(0)
        apart = [float(np.abs(np.diff(s.vel[0], axis=0)).max()) for s in (start, two.run(start, 300))]
        assert (apart[1] > apart[0]) == grows


def test_blend_sums_the_gains_of_behaviours_and_priority_takes_the_largest() -> None:
    behaviours = Seek(weight=6.0, target=O2), Arrive(weight=4.0, target=O2, slow_radius=SLOW)
    blended = suggest_dt(scene(Steer(behaviours=behaviours, arbitration={"kind": "blend"})))
    assert blended.dt == pytest.approx(semi_implicit(4 * TOP / SLOW, 10.0), rel=1e-3)
    first = suggest_dt(scene(Steer(behaviours=behaviours, arbitration={"kind": "priority"})))
    assert first.dt == pytest.approx(semi_implicit(4 * TOP / SLOW, 6.0), rel=1e-3)


def test_an_unstable_behaviour_causes_a_warning_and_is_never_refused() -> None:
    """Its force may be limited by max_force, or be 0 in places; without force there is no limit."""
    with pytest.warns(UnstableStepWarning, match="at most 0.002 s is stable"):
        scene(Seek(weight=1000.0, target=O2), dt=0.05, max_force=4.0)
    assert suggest_dt(scene(Seek(weight=1000.0, target=O2), max_force=0.0)).dt == math.inf
    assert suggest_dt(scene(Seek(weight=0.0, target=O2))).dt == math.inf
