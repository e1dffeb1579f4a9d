"""Arbitration: what every kind must obey, how the kinds differ, and how `Steer` uses them in scenes."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import AvoidObstacles, Separation
from flockenv.behaviours.reconciliation import reconcile
from flockenv.behaviours.steer import Steer
from flockenv.engine import step_of
from flockenv.geometry.space import Torus
from flockenv.maths.counter_rng import key_of
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag, Effect
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from flockenv.steering.arbitration import (
    ARBITRATIONS,
    Allocation,
    Arbitration,
    Blend,
    ContextSteering,
    Dithering,
    Priority,
    RoundRobin,
    RunningSum,
    allocate,
    allocate_running,
)
from flockenv.steering.vectorize import rows
from flockenv.studies.arbitration_trace import arbitration_shares
from flockenv.studies.cost_breakdown import _shares
from tests import catalogue
from tests.catalogue import Array
from tests.kernels import functions_of

ALL = pytest.mark.parametrize("arbitration", catalogue.ARBITRATIONS, ids=lambda a: a.kind)
PRECISIONS = pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
DIMENSIONS = pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])

BUDGET = 10.0


def requests(dimension: int, count: int = 3, many: int = 200) -> Array:
    """Return steering forces of all magnitudes, some of them zero, (R, K, D) N."""
    rng = np.random.default_rng(3)
    forces = rng.normal(size=(many, count, dimension)) * 10 ** rng.uniform(-3, 3, (many, count, 1))
    return np.asarray(forces * (rng.random((many, count, 1)) < 0.8))


def reconciled(arbitration: Arbitration, forces: Array, **more: Any) -> tuple[Any, Any]:
    """Return force and shares for different agents, each at another time."""
    r = len(forces)
    given = {"max_force": BUDGET, "time": np.arange(r) * 0.05, "key": key_of(1, 0), "who": np.arange(r)} | more
    return reconcile(arbitration, forces, **given)


# --- what all obey ----------------------------------------------------------------------------------------------------


@DIMENSIONS
@PRECISIONS
@ALL
def test_shares_are_between_0_and_1_and_sum_to_the_force(arbitration: Arbitration, dtype: str, dimension: int) -> None:
    """For blend before the sum is bounded. Not for context steering: its force is no sum of the steering forces."""
    forces = requests(dimension).astype(dtype)
    force, share = reconciled(arbitration, forces, dtype=dtype)
    assert force.dtype == share.dtype == np.dtype(dtype)
    assert ((share >= 0) & (share <= 1)).all()
    length = np.linalg.norm(force, axis=-1, keepdims=True)
    if isinstance(arbitration, Blend):
        force = force * np.minimum(1, BUDGET / np.maximum(length, 1e-9))
    else:
        assert (length <= BUDGET * (1 + 8 * np.finfo(dtype).eps)).all()
    if not isinstance(arbitration, ContextSteering):
        atol = 64 * np.finfo(dtype).eps * BUDGET * max(1, np.abs(forces).max() / BUDGET)
        np.testing.assert_allclose((share[..., None] * forces).sum(axis=1), force, atol=atol)


@DIMENSIONS
@PRECISIONS
@ALL
def test_the_force_is_finite_for_zero_forces_and_for_a_budget_of_0_or_infinity(
    arbitration: Arbitration, dtype: str, dimension: int
) -> None:
    """Without a bound each share is 0 or 1."""
    forces = np.concatenate([requests(dimension), np.zeros((1, 3, dimension)), np.ones((1, 3, dimension))])
    for budget in (0.0, math.inf, BUDGET):
        force, share = reconciled(arbitration, forces, max_force=budget, dtype=dtype)
        assert np.isfinite(force).all()
        assert np.isfinite(share).all()
        np.testing.assert_array_equal(force[-2], 0)
        if budget == 0 and not isinstance(arbitration, Blend):
            np.testing.assert_array_equal(force, 0)
        if math.isinf(budget) and not isinstance(arbitration, ContextSteering):
            assert np.isin(share, (0, 1)).all()


@ALL
def test_a_single_force_within_the_budget_is_granted_in_full(arbitration: Arbitration) -> None:
    """By context steering exactly, because the direction of the force is one of those it scores."""
    forces = np.array([[(3.0, 4.0)], [(-6.0, 8.0)], [(0.0, 0.5)]])
    arbitration = arbitration.model_copy(update={"dangers": 0}) if arbitration.kind == "context" else arbitration
    arbitration = (
        arbitration.model_copy(update={"probability": 1.0}) if arbitration.kind == "dithering" else arbitration
    )
    force, share = reconciled(arbitration, forces)
    np.testing.assert_allclose(force, forces[:, 0], rtol=1e-12)
    np.testing.assert_allclose(share, 1, rtol=1e-12)


# --- how the kinds differ ---------------------------------------------------------------------------------------------

CONFLICT = np.array([[(8.0, 0.0), (-8.0, 0.0), (0.0, 5.0)]])


def test_allocation_and_running_sum_differ_for_opposite_forces() -> None:
    """(8, 0), (-8, 0), (0, 5) within 10: either lengths use up the budget, or the length of the sum does."""
    force, share = reconciled(Allocation(), CONFLICT)
    np.testing.assert_allclose(force, [(6, 0)])
    np.testing.assert_allclose(share, [(1, 0.25, 0)])
    force, share = reconciled(RunningSum(), CONFLICT)
    np.testing.assert_allclose(force, [(6, 4)])
    np.testing.assert_allclose(share, [(1, 0.25, 0.8)])
    np.testing.assert_allclose(rows(allocate)(CONFLICT, BUDGET), [(6, 0)])
    np.testing.assert_allclose(rows(allocate_running)(CONFLICT, BUDGET), [(6, 4)])


def test_41_forces_are_combined() -> None:
    """One compiled function nested in another for each force failed at about 30."""
    force, share = reconciled(Blend(), np.ones((2, 41, 2)), max_force=1e3)
    np.testing.assert_array_equal(force, np.full((2, 2), 41.0))
    np.testing.assert_array_equal(share, np.ones((2, 41)))


def test_opposite_forces_cancel_in_a_blend() -> None:
    force, share = reconciled(Blend(), CONFLICT[:, :2])
    np.testing.assert_array_equal(force, [(0, 0)])
    np.testing.assert_array_equal(share, [(1, 1)])


def test_a_first_force_above_the_budget_takes_all_of_it() -> None:
    emergency = np.array([[(0.0, 25.0), (4.0, 0.0), (1.0, 1.0)]])
    for arbitration in (Allocation(), RunningSum(), Priority()):
        force, share = reconciled(arbitration, emergency)
        np.testing.assert_allclose(force, [(0, 10)])
        np.testing.assert_allclose(share, [(0.4, 0, 0)], atol=1e-15)


def test_priority_skips_forces_up_to_its_threshold() -> None:
    for first, expected in ((0.5, (0, 5)), (0.51, (0.51, 0))):
        force, _ = reconciled(Priority(threshold=0.5), np.array([[(first, 0.0), (0.0, 5.0)]]))
        np.testing.assert_allclose(force, [expected])


def test_dithering_selects_each_force_with_its_probability() -> None:
    """p, (1 - p) q and otherwise none, within four standard deviations of 20,000 worlds, times or agents."""
    many = 20_000
    forces = np.tile(CONFLICT[:, :2], (many, 1, 1))
    keys = np.array([key_of(seed, 0) for seed in range(many)])
    dithering = Dithering(probability=(0.7, 0.5), period=0.1)
    for more in ({"key": keys, "time": 0.0, "who": 0}, {"time": 0.1 * np.arange(many), "who": 0}, {"time": 0.0}):
        _, share = reconciled(dithering, forces, **more)
        found = [share[:, 0].mean(), share[:, 1].mean(), (share == 0).all(axis=1).mean()]
        np.testing.assert_allclose(found, [0.7, 0.15, 0.15], atol=4 * 0.5 / math.sqrt(many))


@pytest.mark.parametrize("arbitration", [Dithering(probability=0.5, period=0.1), RoundRobin(period=0.1)])
@PRECISIONS
def test_the_selected_force_does_not_depend_on_dt(arbitration: Arbitration, dtype: str) -> None:
    """Not even at multiples of the period: floor(0.3 / 0.1) is 2 or 3 by rounding."""
    whole = np.arange(600)  # times of 0.1 s
    found = []
    for dt in (0.1, 0.05, 0.02, 0.01):
        time = (whole * round(0.1 / dt)) * dt
        found.append(reconciled(arbitration, np.tile(CONFLICT, (600, 1, 1)), time=time, who=0, dtype=dtype)[1])
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])
    if isinstance(arbitration, RoundRobin):
        np.testing.assert_array_equal(np.argmax(found[0] > 0, axis=1), whole % 3)


def test_round_robin_selects_each_force_for_one_period() -> None:
    time = np.arange(60) * 0.01 + 0.005
    _, share = reconciled(RoundRobin(period=0.1), np.tile(CONFLICT, (60, 1, 1)), time=time)
    np.testing.assert_array_equal(np.argmax(share, axis=1), np.repeat([0, 1, 2, 0, 1, 2], 10))
    assert (share.sum(axis=1) == 1).all()


@DIMENSIONS
def test_context_steering_selects_a_least_dangerous_direction(dimension: int) -> None:
    """Least dangerous of all directions, not only of those that it scores, up to the angle between two of these."""
    context = ContextSteering(dangers=2, directions=256)
    forces = requests(dimension, count=4)
    force, _ = reconciled(context, forces, max_force=math.inf)
    some = np.linalg.norm(force, axis=-1) > 1e-9
    ways = np.random.default_rng(0).normal(size=(4000, dimension))
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)

    def danger(way: Array) -> Array:
        return np.asarray(np.maximum(0, -np.einsum("rkd,rwd->rwk", forces[some][:, :2], way)).sum(axis=-1))

    gone = force[some] / np.linalg.norm(force[some], axis=-1, keepdims=True)
    many = np.broadcast_to(ways, (int(some.sum()), *ways.shape))
    apart = math.pi / 256 if dimension == 2 else 2 * math.sqrt(math.pi / 256)
    least, most = danger(many).min(axis=1), danger(many).max(axis=1)
    assert (danger(gone[:, None])[:, 0] <= least + 2 * (apart + 1e-3) * most).all()
    assert some.mean() > 0.9


def test_context_steering_goes_around_a_danger_that_stalls_a_blend() -> None:
    """A danger ahead is as strong as the goal behind it: their sum almost vanishes, a safe force does not."""
    forces = np.array([[(-8.0, 0.0), (8.0, 0.5)]])
    force, _ = reconciled(ContextSteering(), forces)
    assert np.linalg.norm(force) > 0.4
    assert force[0, 0] <= 0.1
    np.testing.assert_allclose(reconciled(Blend(), forces)[0], [(0, 0.5)])


# --- Steer, in scenes -------------------------------------------------------------------------------------------------

SEPARATION = Separation(weight=6.0, radius=2.5)
AVOID = AvoidObstacles(weight=5.0, horizon=3.0, margin=0.1)


def crowd(*effects: Effect, **more: Any) -> Scene:
    """Return a scene of two groups of small max_force among two obstacles."""
    spawn = Spawn(speed=(0.5, 1.5))
    groups = tuple(Group(count=n, max_force=4.0, max_speed=2.0, spawn=spawn) for n in (9, 7))
    given: dict[str, Any] = {
        "space": Torus(size=(9.0, 9.0)), "groups": groups, "effects": effects, "dt": 0.05,
        "obstacles": ({"centre": (3.0, 3.0), "radius": 0.7}, {"centre": (6.5, 5.0), "radius": 0.5}),
    }  # fmt: skip
    return Scene(**given | more)


@pytest.mark.slow
def test_a_blend_of_one_behaviour_equals_the_behaviour() -> None:
    """Bit for bit: the sum is bounded only once."""
    alone, steered = crowd(SEPARATION), crowd(Steer(behaviours=(SEPARATION,), arbitration=Blend()))
    ends = [scene.run(scene.start(2, worlds=3), 60) for scene in (alone, steered)]
    np.testing.assert_array_equal(ends[0].x, ends[1].x)
    np.testing.assert_array_equal(ends[0].v, ends[1].v)


@pytest.mark.slow
def test_steer_acts_on_its_group_alone_and_its_trace_matches_the_force() -> None:
    steer = Steer(group=1, behaviours=(AVOID, SEPARATION), arbitration=Allocation())
    scene = crowd(steer)
    state = scene.start(2, worlds=3)
    end = scene.run(state, 40)
    np.testing.assert_array_equal(end.vel[:, :9], state.vel[:, :9])
    assert not np.allclose(end.vel[:, 9:], state.vel[:, 9:])

    before = end.work.copy()
    found = arbitration_shares(scene, end)[0]
    np.testing.assert_array_equal(end.work, before)  # the trace leaves the scene's counters alone
    assert (found.names, found.effect) == (("avoid_obstacles", "separation"), 0)
    np.testing.assert_array_equal(found.requested[:, :9], 0)
    np.testing.assert_array_equal(found.share[:, :9], 0)
    np.testing.assert_allclose(found.force, scene.acceleration(end), atol=1e-12)  # 1 kg
    np.testing.assert_allclose((found.share[..., None] * found.requested).sum(axis=2), found.force, atol=1e-12)
    assert np.linalg.norm(found.requested, axis=-1).max() > 4.0  # a single behaviour's force is not bounded
    assert found.is_cut.any()
    assert set(found.mean_share()) == {"avoid_obstacles", "separation"}
    where = found.is_active[..., 1]
    assert found.mean_share()["separation"] == pytest.approx(float(found.share[..., 1][where].mean()))
    shares = _shares(scene, state)  # as shown by `flockenv explain`: means over a run
    assert [(where, name) for where, name, _ in shares] == [("effects[0]", name) for name in found.names]
    assert all(0 < mean <= 1 for _, _, mean in shares)
    assert _shares(crowd(SEPARATION), state) == ()
    order = found.is_active[..., 0] & found.is_active[..., 1]
    assert (found.share[order][:, 0] >= found.share[order][:, 1]).all()


def test_a_kernel_contains_only_what_its_behaviours_need() -> None:
    """No neighbour query without a behaviour that sees neighbours, and no code of `Steer` without a `Steer`."""
    scene = crowd(Steer(behaviours=(AVOID,)))
    assert "lanes_meet" in functions_of(crowd(SEPARATION))
    assert "lanes_meet" not in functions_of(scene)
    assert "steers" in functions_of(scene)
    assert "steers" not in functions_of(crowd(AVOID, SEPARATION))
    assert step_of(crowd(Drag(rate=1)).parts) is step_of(crowd(Drag(rate=2)).parts)


@ALL
def test_steer_survives_a_round_trip_through_yaml(arbitration: Arbitration) -> None:
    scene = crowd(Steer(group=1, behaviours=(AVOID, SEPARATION), arbitration=arbitration), Drag(rate=0.1))
    again = load_scene(dump_scene(scene))
    assert again == scene
    assert again.effects[0].arbitration == arbitration  # type: ignore[attr-defined]  # a Steer's


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arbitration", "dtype", "dimension"),
    [(a, *(("float64", 3) if k == 0 else ("float32", 2))) for k, a in enumerate(catalogue.ARBITRATIONS)],  # one in 3-D
    ids=lambda value: getattr(value, "kind", value),
)
def test_every_arbitration_steers_a_scene(arbitration: Arbitration, dtype: str, dimension: int) -> None:
    """The kernel applies the law, and stays finite for agents at rest in one place."""
    change: dict[str, Any] = {"dtype": dtype, "dimension": dimension, "space": Torus(size=(9.0,) * dimension)}
    change["obstacles"] = tuple({"centre": (x,) * dimension, "radius": 0.7} for x in (3.0, 6.5))
    scene = crowd(Steer(behaviours=(AVOID, SEPARATION), arbitration=arbitration), **change)
    end = scene.run(scene.start(4, worlds=2), 25)
    found = arbitration_shares(scene, end)[0].force
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    bounded = found * np.minimum(1, 4 / np.maximum(length, 1e-9))
    tolerance = 1e-11 if dtype == "float64" else 2e-3
    np.testing.assert_allclose(bounded, scene.acceleration(end), atol=tolerance)
    end.pos[...] = 3.0
    end.vel[...] = 0
    after = scene.run(end, 5)
    assert np.isfinite(after.pos).all()


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Steer(behaviours=(Drag(rate=1),)), ("behaviours[0].kind = drag", "is not a behaviour")),
        (lambda: Steer(behaviours=(Steer(behaviours=(AVOID,)),)), ("behaviours[0].kind = steer", "is not a behaviour")),
        (lambda: Steer(behaviours=()), ("behaviours",)),
        (lambda: crowd(Steer(group=2, behaviours=(AVOID,))), ("effects[0].group = 2", "2 groups")),
        (
            lambda: Steer(behaviours=(AVOID, SEPARATION), arbitration=Dithering(probability=(0.5,))),
            ("arbitration.probability = (0.5,)", "2 behaviours"),
        ),
        (lambda: Dithering(probability=1.5), ("probability",)),
        (lambda: RoundRobin(period=0), ("period",)),
        (lambda: ContextSteering(directions=3), ("directions",)),
        (lambda: Steer(behaviours=(AVOID,), arbitration={"kind": "blnd"}), ("arbitration", "blend")),
    ],
)
def test_an_invalid_arbitration_is_refused_in_one_line(make: Any, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=re.escape(words[0])) as refused:
        make()
    text = str(refused.value)
    assert "\n" not in text
    for word in words:
        assert word in text


def test_forces_of_a_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"forces has shape \(3, 2\), expected \(R, K, D\)"):
        reconcile(Blend(), np.zeros((3, 2)), BUDGET)


def test_every_kind_is_registered_once() -> None:
    assert sorted(ARBITRATIONS) == sorted(a.kind for a in (*catalogue.ARBITRATIONS, *catalogue.RECALLING))
