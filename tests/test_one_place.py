"""Agents in one place: they part along their ties and count as neighbours; other pairs are computed without ties."""

from __future__ import annotations

from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.engine.pair_plan import pairs_of
from flockenv.engine.pair_sums import begin_sums
from flockenv.geometry.cell_list import WORTH_ARRANGING
from flockenv.geometry.space import Plane, Torus
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.group import Group
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects.effect import Effect, Me, Other, separation_directions
from flockenv.physics.integrators import RK4
from flockenv.scene import Scene
from flockenv.steering.others import ONE_PLACE
from tests.catalogue import EFFECTS, scene_under, users_module

RULES = (Separation(weight=1.5, radius=1.5), Alignment(weight=0.6, radius=2), Cohesion(weight=0.2, radius=2.5))
SIZE = 20.0
STACKS = ((3, 5), (2, 8, 9), (0, 1, 4, 6))  # numbers of the agents that share a place


def crowd(
    count: int, dimension: int, dtype: str, torus: bool, *effects: Effect, drawn: float = 6.0
) -> tuple[Scene, State]:
    """Return agents near a corner of the box: some of them share a place, and some are at the edge of the box."""
    space = Torus(size=(SIZE,) * dimension) if torus else Plane()
    spawn = Spawn(low=(0.0,) * dimension, high=(drawn,) * dimension)
    group = Group(count=count, mass=1, max_speed=100, max_force=1e6, spawn=spawn)
    scene = Scene(dimension=dimension, space=space, effects=effects or RULES, groups=(group,), dtype=dtype, dt=0.01)
    state, rng = scene.start(seed=1), np.random.default_rng(count)
    state.x[:, 0] = rng.uniform(0, drawn, (dimension, count))
    state.v[:, 0] = rng.uniform(-1, 1, (dimension, count))
    for stack in STACKS:
        for agent in stack:
            state.x[:, 0, agent] = state.x[:, 0, stack[0]]
    state.x[:, 0, [0, 1, 4, 6]] = 0.0  # at the corner of the box
    return scene, state


def expected(scene: Scene, state: State) -> Any:
    """Return the acceleration from the formulas of the three rules, agent by agent, in double precision."""
    x, v, d = state.pos[0].astype(float), state.vel[0].astype(float), scene.dimension
    tie, out = separation_directions(len(x), d), np.zeros((len(x), d))
    for i in range(len(x)):
        to = x - x[i]
        if isinstance(scene.space, Torus):
            to -= SIZE * np.round(to / SIZE)
        square, other = (to**2).sum(axis=1), np.arange(len(x)) != i
        apart, agree, near = (other & (square < rule.radius**2) for rule in RULES)
        here, there = apart & (square <= 1e-30), apart & (square > 1e-30)
        push = (-to[there] / square[there, None]).sum(axis=0) + (tie[i] - tie[here]).sum(axis=0)
        out[i] = RULES[0].weight * push
        if agree.any():
            out[i] += RULES[1].weight * (v[agree].mean(axis=0) - v[i])
        if near.any():
            out[i] += RULES[2].weight * to[near].mean(axis=0)
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "dimension", "dtype", "torus"),
    [(10, 2, "float64", False), (33, 2, "float32", True),
     pytest.param(700, 2, "float64", True, marks=pytest.mark.slow),
     pytest.param(700, 3, "float32", True, marks=pytest.mark.slow),
     pytest.param(33, 3, "float64", False, marks=pytest.mark.slow)],
)  # fmt: skip
def test_the_three_rules_follow_their_formulas(count: int, dimension: int, dtype: str, torus: bool) -> None:
    scene, state = crowd(count, dimension, dtype, torus, drawn=6.0 if count < 100 else SIZE)
    assert scene.parts.parting
    found, by_the_book = scene.acceleration(state)[0], expected(scene, state)
    close = {"float64": 1e-10, "float32": 2e-5}[dtype] * np.abs(by_the_book).max()
    np.testing.assert_allclose(found, by_the_book, rtol=0, atol=close)
    for stack in STACKS:
        assert len(np.unique(found[list(stack)].round(3), axis=0)) == len(stack)  # they part


def test_all_agents_in_one_place_part_with_zero_total_force() -> None:
    """The 40 agents fill more than one block."""
    scene, state = crowd(40, 2, "float64", False, RULES[0])
    state.x[...] = 3.0
    found = scene.acceleration(state)[0]
    tie = separation_directions(40, 2)
    np.testing.assert_allclose(found, 1.5 * (40 * tie - tie.sum(axis=0)), atol=1e-11)
    np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("nearest", [1, 2])
def test_agents_in_the_same_place_are_among_the_nearest(nearest: int) -> None:
    scene, state = crowd(
        10, 2, "float64", False, Cohesion(weight=1, radius=9), Separation(weight=1, radius=9, nearest=nearest)
    )
    assert scene.parts.parting
    tie, pull = separation_directions(10, 2), scene.acceleration(state)[0]
    lone, _ = crowd(10, 2, "float64", False, Cohesion(weight=1, radius=9))
    push = pull - lone.acceleration(state)[0]
    pair = STACKS[0]
    if nearest == 1:
        np.testing.assert_allclose(push[pair[0]], tie[pair[0]] - tie[pair[1]], atol=1e-12)
    else:  # each of a stack of three sees only the other two
        for agent in STACKS[1]:
            np.testing.assert_allclose(push[agent], sum(tie[agent] - tie[k] for k in STACKS[1]), atol=1e-12)


def test_absent_agents_push_no_agent_in_the_same_place() -> None:
    scene, state = crowd(10, 2, "float64", False)
    whole = scene.acceleration(state)[0]
    state.alive[0, 5] = False
    found = scene.acceleration(state)[0]
    tie = separation_directions(10, 2)
    lone, _ = crowd(10, 2, "float64", False, RULES[0])
    state.alive[0, 5] = True
    before = lone.acceleration(state)[0, 3]
    state.alive[0, 5] = False
    np.testing.assert_allclose(lone.acceleration(state)[0, 3], before - 1.5 * (tie[3] - tie[5]), atol=1e-12)
    assert (found[5] == 0).all() and (whole[5] != 0).any()


@pytest.mark.slow
@pytest.mark.parametrize("count", [700, WORTH_ARRANGING + 3])
def test_one_call_of_four_steps_equals_four_calls_if_agents_share_a_place(count: int) -> None:
    """A call may sort agents in memory: ties belong to agent numbers, not to places in memory."""
    scene, state = crowd(count, 2, "float64", True, drawn=SIZE)
    state.x[:, 0, 100:130] = state.x[:, 0, 100:101]
    one = scene.step(state, steps=4)
    for _ in range(4):
        state = scene.step(state)
    assert np.unique(state.x[:, 0, 100:130], axis=1).shape[1] == 30
    np.testing.assert_array_equal(one.x, state.x)
    np.testing.assert_array_equal(one.v, state.v)


@pytest.mark.slow
def test_records_beyond_the_last_agent_change_no_result() -> None:
    """The unused lanes of the last block hold such records; their values must not be used as indices."""
    scene, state = crowd(700, 2, "float64", True, drawn=SIZE)
    state.x[:, 0, [50, 51]] = SIZE - 1e-3  # in the very last cell
    state.alive[0, 600:] = False
    expected_ = scene.acceleration(state)
    scene.stepper.workspaces(1, 1)[0].arrays["records"][:] = 1e12
    np.testing.assert_array_equal(scene.acceleration(state), expected_)


TIED = """
from typing import ClassVar, Literal
from flockenv.behaviours import Separation
from flockenv.jit.decorators import Law, law
from flockenv.steering import others
from flockenv.maths.vectors import add, sub


@law
def pushed(p, me, other):
    return others.part(other.offset, other.square, sub(me.tie, other.tie))


@law
def pushed_apart(p, me, other):
    return others.push_off(other.offset, other.square)


@law
def ended(p, me, sums):
    return add(sums, me.tie)


class Tied(Separation):
    kind: Literal["tied"] = "tied"
    pair_law: ClassVar[Law | None] = pushed
    apart_law: ClassVar[Law | None] = pushed_apart
    finish_law: ClassVar[Law | None] = ended
    vanishes: ClassVar[bool] = False
"""


def test_ties_are_sorted_with_the_agents_if_the_law_of_agents_elsewhere_reads_them(tmp_path: Path) -> None:
    with users_module(tmp_path, TIED, "tied_laws") as laws:
        scene, _ = crowd(700, 2, "float64", True, laws.Tied(weight=1.0, radius=1.0))
        assert not scene.parts.parting
        assert {"t0", "t1"} <= set(scene.parts.sorted_fields)


@pytest.mark.slow
def test_an_agent_outside_of_the_box_counts_as_its_image_inside() -> None:
    """This matters for `acceleration` only: a step first moves all agents into the box."""
    scene, state = crowd(700, 2, "float64", True, drawn=SIZE)
    rng = np.random.default_rng(5)
    state.x[...] = np.round(state.x * 2**20) / 2**20  # so that images are exact
    inside = scene.acceleration(state)
    state.x[:, 0, ::5] += SIZE * rng.integers(-2, 3, state.x[:, 0, ::5].shape)
    before = state.x.copy()
    np.testing.assert_array_equal(scene.acceleration(state), inside)
    np.testing.assert_array_equal(state.x, before)


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf])
def test_an_agent_that_is_not_finite_is_no_neighbour_and_raises_no_warning(place: float) -> None:
    scene, state = crowd(700, 2, "float64", True, drawn=SIZE)
    without = state.copy()
    without.alive[0, 5] = False
    state.x[0, 0, 5] = place
    found, expected_ = (np.delete(scene.acceleration(s)[0], 5, axis=0) for s in (state, without))
    np.testing.assert_allclose(found, expected_, atol=1e-9 * np.abs(expected_).max())


@pytest.mark.slow
def test_two_threads_and_a_view_cone_change_nothing() -> None:
    scene, state = crowd(700, 2, "float64", True, Separation(weight=1, radius=1.5, fov=200), drawn=SIZE)
    state.x[:, 0, 100:130] = state.x[:, 0, 100:101]
    one = scene.step(state, steps=3)
    before = threads()
    use_threads(2)
    try:
        two = scene.step(state, steps=3)
    finally:
        use_threads(before)
    np.testing.assert_array_equal(one.x, two.x)
    np.testing.assert_array_equal(one.v, two.v)
    assert np.unique(two.x[:, 0, 100:130], axis=1).shape[1] == 30


def test_the_counts_of_agents_in_the_same_place_start_at_zero_for_each_block() -> None:
    """Otherwise blocks after the first would visit their candidates twice, and no result would show it."""
    scene, _ = crowd(10, 2, "float64", False)
    plan = pairs_of(scene.parts)
    lanes, first = np.full(len(scene.parts.slots) * plan.lanes, 7.0), int(plan.listing.slot("here0"))
    begin, numbers, block = begin_sums(plan), namedtuple("N", "reach")(1.0), namedtuple("B", "lanes")(lanes)  # type: ignore[call-arg]
    njit(lambda numbers, block: begin(numbers, (), block))(numbers, block)
    assert (lanes[first : first + plan.lanes] == 0).all()
    assert (lanes == 7).any()  # all other numbers of the block stay


WITH_BOTH = [row for row in EFFECTS if row.effect.apart_law is not None]


@pytest.mark.parametrize("row", WITH_BOTH, ids=lambda row: row.name)
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_law_for_agents_elsewhere_equals_the_pair_law(row: Any, dimension: int) -> None:
    """For arbitrary ties."""
    effect = next(e for e in scene_under(row, dimension).parts.effects if e.kind == row.effect.kind)
    whole, elsewhere = effect.pair_law, effect.apart_law
    numbers = effect.parameters()
    p, rng = namedtuple("P", numbers)(**numbers), np.random.default_rng(0)  # type: ignore[misc]

    @njit(error_model="numpy", fastmath={"contract"})
    def both(p: Any, me: Any, other: Any) -> Any:
        return whole(p, me, other), elsewhere(p, me, other)

    def drawn() -> tuple[float, ...]:
        return tuple(rng.normal(size=dimension).tolist())

    for k in range(20):
        offset = tuple(x * (1.0, 3e-15)[k % 2] for x in drawn())  # half of the offsets are barely longer than zero
        square = sum(x * x for x in offset)
        assert square > ONE_PLACE
        me = Me(0.0, drawn(), drawn(), drawn(), 1.0, 0.3, 2.0, 4.0, drawn(), 0.0, drawn(), 0, drawn(), 1.3, ())
        one, other = both(p, me, Other(1.0, offset, square, drawn(), 0.3, drawn(), 1.0, ()))
        assert one == other


VANISHING = [row for row in EFFECTS if row.effect.vanishes]


@pytest.mark.parametrize("row", VANISHING, ids=lambda row: row.name)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_law_that_vanishes_is_zero_at_an_infinite_distance(row: Any, dimension: int) -> None:
    """For any offset: steps pass an infinite square for agents out of sight."""
    effect = next(e for e in scene_under(row, dimension).parts.effects if e.kind == row.effect.kind)
    whole, elsewhere = effect.pair_law, effect.apart_law or effect.pair_law
    numbers, rng = effect.parameters(), np.random.default_rng(0)
    p = namedtuple("P", numbers)(**numbers)  # type: ignore[misc]

    @njit(error_model="numpy")
    def both(p: Any, me: Any, other: Any) -> Any:
        return whole(p, me, other), elsewhere(p, me, other)

    def drawn() -> tuple[float, ...]:
        return tuple(rng.normal(size=dimension).tolist())

    for scale in (0.0, 1e-20, 1.0, 1e20):
        offset = tuple(scale * x for x in drawn())
        me = Me(0.0, drawn(), drawn(), drawn(), 1.0, 0.3, 2.0, 4.0, drawn(), 0.0, drawn(), 0, drawn(), 1.3, ())
        for result in both(p, me, Other(1.0, offset, np.inf, drawn(), 0.3, drawn(), 1.0, ())):
            assert not any(result)


@pytest.mark.slow
def test_the_agent_at_nan_is_named_although_neighbours_see_it() -> None:
    """Laws that vanish give NaN for it; methods of several stages mask it instead (`trusts` is False)."""
    scene, state = crowd(40, 2, "float64", False)
    state.x[0, 0, 7] = np.nan
    with pytest.raises(SimulationDiverged, match="agent 7"):
        scene.step(state)
    assert scene.parts.trusts
    several = scene.model_copy(update={"integrator": RK4()})
    assert not several.parts.trusts
    with pytest.raises(SimulationDiverged, match="agent 7"):
        several.step(state)


def test_the_first_agent_that_diverges_is_named_in_a_call_of_many_steps() -> None:
    """By the kernel itself: a task does not repeat the steps one by one."""
    scene, state = crowd(40, 2, "float64", False, RULES[0])
    assert scene.parts.spreads
    state.v[1, 0, 7] = np.nan
    for steps in (1, 2, 5):
        assert scene.stepper.advance(state.copy(), np.zeros((2, 0, 0)), steps)[:2] == (0, 7)


@pytest.mark.slow
def test_neighbours_of_equal_sights_are_counted_once() -> None:
    """Alignment and cohesion share a count if their radii are equal."""
    far = Cohesion(weight=0.2, radius=2.5)
    for rules, many in (((RULES[1], RULES[2]), 2), ((RULES[1], far.model_copy(update={"radius": 2})), 1)):
        scene, state = crowd(10, 2, "float64", False, *rules)
        assert len(scene.parts.counted_sights) == many
        each = [crowd(10, 2, "float64", False, rule)[0].acceleration(state) for rule in rules]
        np.testing.assert_allclose(scene.acceleration(state), sum(each), atol=1e-12)


def test_scenes_with_a_law_of_one_form_have_no_separate_pass_for_one_place() -> None:
    assert not crowd(10, 2, "float64", False, RULES[1])[0].parts.parting  # no law reads ties
    kinds = {row.effect.kind: row.effect for row in EFFECTS}
    for kind in ("pressure", "contact"):
        assert not crowd(10, 2, "float64", False, RULES[0], kinds[kind])[0].parts.parting
