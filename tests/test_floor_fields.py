"""Floor fields, journeys, choice of doors, queues and unaligned avoidance."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockenv.behaviours import Driving, FollowWay, LineUp, UnalignedAvoidance
from flockenv.behaviours.steer import Steer
from flockenv.core.warnings import NoWayWarning
from flockenv.geometry.eikonal import ground
from flockenv.geometry.shapes import Block, Circle, HalfSpace, Polygon, Wall
from flockenv.geometry.space import Box
from flockenv.geometry.targets import Target
from flockenv.jit.thread_pool import use_threads
from flockenv.model.distribution import Spread
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Door, Journey, Routes, Stage, Way
from flockenv.physics.population import Drain, Emitter
from flockenv.physics.population.regions import Point
from flockenv.scene import Group, Scene

Array = NDArray[np.float64]


def walkers(count: int, low: Any, high: Any, speed: Any = 1.0, **more: Any) -> Group:
    spawn = Spawn(low=low, high=high)
    return Group(count=count, radius=0.2, mass=70, desired_speed=speed, spawn=spawn, **more)


# A room of 10 x 6 m, closed but for a door of 1 m on the left and one of 2 m on the right.
ROOM = (
    Wall(vertices=((0, 2.5), (0, 0), (10, 0), (10, 2)), radius=0.1),
    Wall(vertices=((0, 3.5), (0, 6), (10, 6), (10, 4)), radius=0.1),
)
LEFT, RIGHT = ((0.0, 2.5), (0.0, 3.5)), ((10.0, 2.0), (10.0, 4.0))


# --- floor fields -----------------------------------------------------------------------------------------------------


def test_the_path_around_a_disc_is_as_long_as_tangents_and_an_arc() -> None:
    """The body keeps 0.3 m from a disc of radius 0.7 m; the mean error is below 0.05 m."""
    way = Way(targets=(Target(at=(3, 0)),), clearance=0.3, spacing=0.05, margin=4)
    scene = Scene(
        groups=(walkers(1, (-4, 0), (-4, 0)),), obstacles=(Circle(centre=(0, 0), radius=0.7),), effects=(way,)
    )
    x = np.random.default_rng(0).uniform(-4, 4, (400, 2))
    d = np.linalg.norm(x, axis=1)
    x, d = x[d > 1.1], d[d > 1.1]
    arc = np.arccos(x[:, 0] / d) - np.arccos(1 / d) - math.acos(1 / 3)
    exact = np.where(arc <= 0, np.linalg.norm(x - (3, 0), axis=1), np.sqrt(d**2 - 1) + math.sqrt(8) + arc)
    wrong = way.lengths(scene, x) - exact
    assert np.abs(wrong).mean() < 0.05
    assert np.abs(wrong).max() < 0.2


def test_the_nearest_target_is_the_one_with_the_shortest_path() -> None:
    """One target, behind a wall, is 3 m away in a straight line but 13 m by the path; the other is 6 m away."""
    wall = (Wall(vertices=((2, -6), (2, 20)), radius=0.1),)
    way = Way(targets=(Target(at=(3, 0)), Target(at=(-6, 0))), spacing=0.1, margin=1)
    scene = Scene(groups=(walkers(1, (0, 0), (0, 0)),), obstacles=wall, effects=(way,))
    assert way.lengths(scene, [0.0, 0.0]) == pytest.approx(6, abs=0.1)
    one = way.model_copy(update={"targets": way.targets[:1]})
    there, back, r = (
        math.hypot(2, 6),
        math.hypot(1, 6),
        0.4,
    )  # tangents to a disc around the end of the wall, and an arc
    arc = 2 * math.pi - math.atan(2 / 6) - math.atan(1 / 6) - math.acos(r / there) - math.acos(r / back)
    around = math.sqrt(there**2 - r**2) + math.sqrt(back**2 - r**2) + r * arc
    assert one.lengths(scene.with_effects(one), [0.0, 0.0]) == pytest.approx(around, rel=0.04)


def test_path_lengths_continue_into_the_clearance_of_walls() -> None:
    """Floor fields end at the clearance of a jamb; without continued lengths agents nearer to it would turn away."""
    way = Way(targets=(Target(ends=LEFT),), spacing=0.1)
    scene = Scene(groups=(walkers(1, (5, 3), (5, 3)),), obstacles=ROOM, effects=(way,))
    assert way.lengths(scene, [0.2, 3.2]) == pytest.approx(0.25, abs=0.15)
    assert way.lengths(scene, [5.0, 0.3]) == pytest.approx(math.hypot(5, 2.6), abs=0.5)


def test_floor_fields_of_several_targets_share_the_distances_to_obstacles() -> None:
    """Distances to obstacles do not depend on targets."""
    ground.cache_clear()
    targets = tuple(Target(at=(x, 3.0)) for x in (2, 4, 6))
    stages = tuple(Stage(at=target.at, radius=0.3) for target in targets)
    Scene(groups=(walkers(2, (1, 1), (9, 5)),), obstacles=ROOM, effects=(Journey(stages=stages),))
    assert ground.cache_info().misses == 1


def test_an_agent_without_a_path_causes_a_warning_and_stands_still() -> None:
    """A wall across the box, an agent on each side of it, the target on the right."""
    wall = Wall(vertices=((6, 0), (6, 8)), radius=0.1)
    way = Way(targets=(Target(at=(11, 4)),), spacing=0.1)
    scene = Scene(
        space=Box(size=(12, 8)), groups=(walkers(2, (0.5, 0.5), (11, 7)),), obstacles=(wall,),
        effects=(way, Driving(tau=0.5)), dt=0.01,
    )  # fmt: skip
    with pytest.warns(NoWayWarning, match=r"targets\[0\]: no way leads there from where \d+ of 8 agents") as caught:
        state = scene.start(0, 4)
    assert f"where {(state.pos[..., 0] < 6).sum()} of 8" in str(caught[0].message)
    np.testing.assert_array_equal(way.lengths(scene, [(3.0, 4.0), (9.0, 4.0), (5.6, 1)]) == np.inf, [True, False, True])
    assert way.lengths(scene, [9.0, 4.0]) == pytest.approx(2, abs=0.01)
    state = state.worlds([0]).with_motion([[[3.0, 4.0], [9.0, 4.0]]], np.zeros((1, 2, 2)))
    end = scene.run(state, 1000)
    np.testing.assert_array_equal(end.pos[0, 0], (3, 4))
    np.testing.assert_allclose(end.pos[0, 1], (11, 4), atol=0.3)


def cut_off(effect: Any, count: int = 4, **more: Any) -> Scene:
    """Return a scene with a closed cell of 3 x 6 m on the left, in which some of the agents begin."""
    wall = Wall(vertices=((3, 0), (3, 6)), radius=0.1)
    return Scene(
        space=Box(size=(10, 6)), groups=(walkers(count, (1, 1), (9, 5)),), obstacles=(wall,),
        effects=(effect, Driving()), **more,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (Way(targets=(Target(at=(9, 1)), Target(at=(9, 5)))), r"targets\[0\] or targets\[1\]"),
        (Journey(stages=(Stage(at=(5, 3), radius=0.3), Stage(at=(9, 3), radius=0.3))), r"stages\[0\] or stages\[1\]"),
        (Routes(doors=(Door(ends=((10, 1), (10, 2))), Door(ends=((10, 4), (10, 5))))), r"doors\[0\] or doors\[1\]"),
        (Steer(behaviours=(FollowWay(weight=50, target=(9, 3), speed=1.0),)), "target"),
    ],
)
def test_every_effect_with_floor_fields_counts_the_agents_that_are_cut_off(effect: Any, name: str) -> None:
    with pytest.warns(NoWayWarning, match=rf"{name}: no way leads there from where \d+ of 40 agents begin") as caught:
        state = cut_off(effect).start(0, 10)
    count = (state.pos[..., 0] < 3).sum()
    assert f"where {count} of 40" in str(caught[0].message)


def test_one_reachable_door_is_enough_but_every_stage_of_a_journey_is_needed() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cut_off(Way(targets=(Target(at=(1, 3)), Target(at=(9, 3))))).start(0, 10)
        cut_off(Routes(doors=(Door(ends=((0, 1), (0, 2))), Door(ends=((10, 4), (10, 5)))))).start(0, 10)
    stages = Stage(at=(2, 3), radius=0.3), Stage(at=(9, 3), radius=0.3)
    with pytest.warns(NoWayWarning, match="40 of 40 agents"):
        cut_off(Journey(stages=stages)).start(0, 10)


@pytest.mark.slow
def test_an_agent_without_a_path_to_a_later_stage_walks_to_the_stage_before_it() -> None:
    scene = cut_off(Journey(stages=(Stage(at=(2, 3), radius=0.3), Stage(at=(9, 3), radius=0.3))), count=2, dt=0.01)
    with pytest.warns(NoWayWarning, match="they stand still once they head for a place without a way"):
        state = scene.start(0)
    first = scene.run(state.with_motion([[[1.0, 1.0], [2.0, 5.0]]], np.zeros((1, 2, 2))), 2000)
    assert (np.linalg.norm(first.pos[0] - (2, 3), axis=1) < 0.5).all()
    later = scene.run(first, 500)
    np.testing.assert_allclose(later.pos, first.pos, atol=1e-6)


def test_emitters_and_spawns_without_a_path_are_refused() -> None:
    born = (Emitter(group=0, place=Point(at=(1.5, 3.0)), rate=1.0),)
    with pytest.raises(ValueError, match=r"targets\[0\] = \(9.0, 3.0\): no way leads there from population\[0\]"):
        cut_off(Way(targets=(Target(at=(9, 3)),)), population=born)
    with pytest.raises(ValueError, match=r"target = \(1.0, 3.0\): no way leads there from groups\[0\]"):
        Scene(
            space=Box(size=(10, 6)), groups=(walkers(2, (5, 1), (9, 5)),), dt=0.02,
            obstacles=(Wall(vertices=((3, 0), (3, 6)), radius=0.1),),
            effects=(Steer(behaviours=(FollowWay(weight=50, target=(1, 3), speed=1.0),)),),
        )  # fmt: skip


# --- journeys ---------------------------------------------------------------------------------------------------------

STAGES = (
    Stage(ends=((5, 1), (5, 5))),
    Stage(at=(8, 3), radius=0.3, wait=Spread(low=1.0, high=2.0)),
    Stage(ends=RIGHT),
)
THERE = Journey(group=0, stages=STAGES, premovement=Spread(low=0.5, high=1.5), then="leave", spacing=0.1)
LOOP = Journey(
    group=1, stages=(Stage(at=(7, 5), radius=0.3, around=False), Stage(at=(3, 5), radius=0.3, around=False)),
    then="loop", spacing=0.1,
)  # fmt: skip


def travellers(dt: float = 0.02, **more: Any) -> Scene:
    groups = (walkers(5, (1, 1), (4, 5)), walkers(3, (2, 4.5), (6, 5.5)))
    return Scene(groups=groups, obstacles=ROOM, effects=(THERE, LOOP, Driving()), dt=dt, **more)


def history(scene: Scene, seconds: float, name: str = "stage") -> tuple[Array, Array]:
    """Return the times of all steps, and an inner number of every agent at each of them."""
    state, times, found = scene.start(0), [0.0], []
    found.append(np.array(scene.inner(state, name)[0]))
    for _ in range(round(seconds / scene.dt)):
        scene.step(state, out=state)
        times.append(float(state.time[0]))
        found.append(np.array(scene.inner(state, name)[0]))
    return np.array(times), np.array(found)


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05, 0.07])
def test_stages_come_in_order_and_waits_are_exact_for_every_dt(dt: float) -> None:
    scene = travellers(dt)
    times, stage = history(scene, 14)
    table = scene.table_of(THERE)
    drawn = table[3 * 9 : 3 * 9 + 5 * 4].reshape(5, 4)  # premovement, and a wait at each place
    assert np.ptp(drawn[:, 0]) > 0.2
    assert ((drawn[:, 2] >= 1) & (drawn[:, 2] <= 2)).all()
    for i in range(5):
        order = [stage[0, i], *stage[1:, i][np.diff(stage[:, i]) != 0]]
        assert order == [-0.5, 0, 1, 1.5, 2, 3]
        first = {value: times[np.argmax(stage[:, i] == value)] for value in order}
        assert 0 <= first[0.0] - drawn[i, 0] < dt * 1.02  # it sets out in the first step after its time
        assert 0 <= first[2.0] - first[1.5] - drawn[i, 2] < dt * 1.02
    assert (stage[-1, 5:] <= 1).all()
    assert (np.abs(np.diff(stage[:, 5:], axis=0)).sum(axis=0) >= 3).all()  # the loop repeats


def test_agents_rest_until_they_set_out_and_go_straight_on_after_they_left() -> None:
    scene = travellers()
    start = scene.start(0)
    early = scene.run(start, 24)
    np.testing.assert_array_equal(early.pos[0, :5], start.pos[0, :5])
    assert (np.linalg.norm(early.pos - start.pos, axis=-1)[0, 5:] > 0.05).all()
    end = scene.run(early, 800)
    assert (end.pos[0, :5, 0] > 12).all()
    assert (end.pos[0, 5:, 0] < 8).all()
    np.testing.assert_allclose(np.linalg.norm(end.vel[0, :5], axis=1), 1, atol=1e-3)


def test_no_agent_goes_through_a_wall() -> None:
    scene = travellers()
    state, clear = scene.start(3, 4), np.inf
    for _ in range(140):
        scene.step(state, out=state, steps=5)
        clear = min(clear, *(float(wall.gap(state.pos).min()) for wall in ROOM))
    assert clear > 0.15


def test_journeys_do_not_depend_on_threads_batches_or_calls() -> None:
    scene = travellers()
    start = scene.start(5, 3)
    end = scene.step(start, steps=300)
    slow = start.copy()
    for _ in range(300):
        scene.step(slow, out=slow)
    np.testing.assert_array_equal(slow.pos, end.pos)
    np.testing.assert_array_equal(slow.inner, end.inner)
    alone = scene.step(scene.start(6), steps=300)
    np.testing.assert_array_equal(alone.pos[0], end.pos[1])
    np.testing.assert_array_equal(alone.inner[:, 0], end.inner[:, 1])


def test_born_agents_begin_a_journey_of_their_own_and_leave_through_a_drain() -> None:
    scene = travellers(population=(
        Emitter(group=0, place=Point(at=(1.0, 3.0)), rate=1.0),
        Drain(group=0, shape=Wall(vertices=((11, 0), (11, 6)), radius=0.1)),
    ))  # fmt: skip
    state = scene.start(0)
    assert not state.alive[0, :5].any()
    kept: list[tuple[int, float]] = []
    for _ in range(900):
        was = state.identity[0].copy()
        scene.step(state, out=state)
        for i in np.flatnonzero((state.identity[0] != was) & state.alive[0]):
            kept.append((int(i), float(scene.inner(state, "stage")[0, i])))
            ready = scene.inner(state, "ready")[0, i] - state.time[0]
            assert 0.5 <= ready <= 1.5
    assert len(kept) > 7  # slots are used again
    assert {stage for _, stage in kept} == {-0.5}


# --- routes -----------------------------------------------------------------------------------------------------------


def two_groups(groups: Any, routes: Any) -> Scene:
    """Return a room in which agents line up behind agents of their own group; one kernel for all tests."""
    lines = tuple(Steer(group=k, behaviours=(LineUp(margin=0.1, group=k),)) for k in range(2))
    return Scene(groups=groups, obstacles=ROOM, effects=(*routes, *lines), dt=0.02)


def waiting(count: int, doors: tuple[Door, ...], at: Any, **more: Any) -> Array:
    """Return the doors that agents choose within 20 s if they do not walk."""
    routes = tuple(Routes(group=k, doors=doors, spacing=0.1, share=0.0, period=0.5, **more) for k in range(2))
    scene = two_groups((walkers(count, at, at), walkers(1, (5, 5), (5, 5))), routes)
    return np.array(scene.inner(scene.run(scene.start(1), 1000), "door")[0, :count])


EQUAL = (Door(ends=LEFT, width=1.0), Door(ends=RIGHT, width=1.0))


@pytest.mark.slow
def test_agents_divide_between_two_doors_as_computed() -> None:
    """All stand in one place, so half of a door's agents count as ahead: L1 + n1 / (2 J w1) = L2 + n2 / (2 J w2)."""
    more = {"flow": 1.9, "hysteresis": 0.0}
    assert abs((waiting(60, EQUAL, (5, 3), **more) == 0).sum() - 30) <= 3
    assert abs((waiting(60, EQUAL, (3, 3), **more) == 0).sum() - (30 + 1.9 * 4)) <= 3
    wide = (EQUAL[0], Door(ends=RIGHT, width=2.0))
    assert abs((waiting(60, wide, (5, 3), **more) == 1).sum() - 40) <= 3


@pytest.mark.slow
def test_agents_change_their_door_only_if_it_saves_more_than_the_hysteresis() -> None:
    """Nine agents, 4.4 m from one door and 5.6 m from the other: 4.4 + 4 / 1.9 s is 14 % more than 5.6 s."""
    assert (waiting(9, EQUAL, (4.4, 3), hysteresis=0.3) == 0).all()
    assert 0 < (waiting(9, EQUAL, (4.4, 3), hysteresis=0.0) == 1).sum() < 5


@pytest.mark.slow
def test_all_agents_leave_by_their_assigned_door_for_any_number_of_threads() -> None:
    groups = (walkers(20, (1, 1), (9, 5)), walkers(20, (1, 1), (9, 5)))
    doors = (Door(ends=LEFT),), (Door(ends=RIGHT),)
    scene = two_groups(groups, tuple(Routes(group=k, doors=doors[k], spacing=0.1) for k in range(2)))
    start = scene.start(2, 3)
    end = scene.run(start, 2500)
    assert (end.pos[:, :20, 0] < 0).all()
    assert (end.pos[:, 20:, 0] > 10).all()
    np.testing.assert_array_equal(scene.inner(end, "door"), 1)
    use_threads(2)
    try:
        again = scene.run(start, 2500)
    finally:
        use_threads(1)
    np.testing.assert_array_equal(again.pos, end.pos)
    np.testing.assert_array_equal(again.inner, end.inner)


@pytest.mark.slow
def test_door_choices_do_not_depend_on_the_order_of_agents() -> None:
    """The period is one step, since the time of a decision within a period depends on the index of an agent."""
    routes = tuple(Routes(group=k, doors=EQUAL, spacing=0.1, period=0.02) for k in range(2))
    scene = two_groups((walkers(20, (1, 1), (4, 5)), walkers(1, (5, 5), (5, 5))), routes)
    start, order = scene.start(4), [*np.random.default_rng(0).permutation(20), 20]
    mixed = start.copy()
    for array in (mixed.x, mixed.v, mixed.inner):
        array[...] = array[:, :, order]
    end, other = scene.run(start, 300), scene.run(mixed, 300)
    np.testing.assert_allclose(other.pos, end.pos[:, order], atol=1e-9)
    np.testing.assert_array_equal(scene.inner(other, "door"), scene.inner(end, "door")[:, order])
    assert len(np.unique(scene.inner(end, "door")[0, :20])) > 1


@pytest.mark.slow
def test_routes_of_a_large_crowd_do_not_depend_on_threads_or_calls() -> None:
    """Two threads share a large crowd, and a call of many steps sorts its agents."""
    routes = Routes(doors=EQUAL, spacing=0.1, period=0.2)
    groups = (walkers(4200, (1, 1), (4, 5)),)
    scene = Scene(groups=groups, obstacles=ROOM, effects=(routes, Steer(behaviours=(LineUp(margin=0.05),))), dt=0.02)
    start = scene.start(0)
    end = start.copy()
    for _ in range(12):
        scene.step(end, out=end)
    assert (scene.inner(end, "door") != scene.inner(start, "door")).any()
    use_threads(2)
    try:
        again = scene.step(start, steps=12)
    finally:
        use_threads(1)
    np.testing.assert_array_equal(again.inner, end.inner)
    np.testing.assert_array_equal(again.pos, end.pos)


# --- doors that stand free --------------------------------------------------------------------------------------------

FREE = ((11.0, 5.0), (11.0, 6.0))
"""A door without walls, in a box of 12 x 8 m: agents may walk around its ends."""
PASSING = [Routes(doors=(Door(ends=FREE),)), Journey(stages=(Stage(ends=FREE),), then="leave")]


@pytest.mark.slow
@pytest.mark.parametrize("effect", PASSING, ids=lambda effect: effect.kind)
def test_a_free_door_is_passed_away_from_the_side_of_approach(effect: Any) -> None:
    """Several agents pass x = 11 just beside an end of the door; once they turned back and walked away for good."""
    starts = [(7.07, 6.33), (5.07, 1.76), (4.67, 4.48), (10.1, 0.95), (8.0, 5.5), (11.7, 3.0), (11.7, 5.5)]
    groups = tuple(walkers(1, place, place, speed=1.3, max_speed=2) for place in starts)
    scene = Scene(space=Box(size=(12, 8)), groups=groups, effects=(effect, Driving(tau=0.5)), dt=0.01)
    end = scene.run(scene.start(0), 1000)
    np.testing.assert_array_equal(scene.inner(end, effect.keeps[0])[0], 1)
    assert (end.pos[0, :5, 0] > 11.5).all()
    assert (end.pos[0, 5:, 0] < 10).all()


@pytest.mark.slow
@pytest.mark.parametrize("effect", PASSING, ids=lambda effect: effect.kind)
@pytest.mark.parametrize(
    ("places", "passed"),
    [
        ([(10.9, 4.8), (11.1, 4.95), (10.9, 5.35)], [0, 0, 0]),  # around the end, and back through the door
        ([(10.9, 4.8), (11.1, 4.95), (10.9, 5.35), (11.1, 5.35)], [0, 0, 0, 1]),
        ([(10.9, 4.8), (11.1, 4.95), (11.1, 5.05)], [0, 0, 1]),  # around the end, to a place behind the door
        ([(10.9, 4.8), (11.1, 4.95), (13.0, 4.95), (10.9, 5.5)], [0, 0, 0, 1]),  # comes again, from the other side
        ([(11.1, 5.5), (11.1, 4.95), (10.9, 5.35)], [0, 0, 1]),
    ],
)
def test_crossing_a_door_backwards_is_no_passage(effect: Any, places: Any, passed: Any) -> None:
    still = effect.model_copy(update={"share": 0.0})
    scene = Scene(groups=(walkers(1, places[0], places[0]),), effects=(still,), dt=0.01)
    state, found = scene.start(0), []
    for place in places:
        state.pos[0, 0] = place
        scene.step(state, out=state)
        found.append(int(scene.inner(state, effect.keeps[0])[0, 0]))
    assert found == passed


# --- queues and avoidance ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_agent_that_lines_up_stops_a_margin_behind_the_agent_ahead() -> None:
    """Agents of the second group do not walk; the gap of the first to the one ahead never falls below the margin."""
    groups = (walkers(1, (1, 3), (1, 3)), walkers(2, (4, 3), (6, 3)))
    routes = tuple(Routes(group=k, doors=(Door(ends=RIGHT),), spacing=0.1) for k in range(2))
    routes = (routes[0], routes[1].model_copy(update={"share": 0.0}))
    lines = tuple(Steer(group=k, behaviours=(LineUp(margin=0.1, group=1 - k),)) for k in range(2))
    scene = Scene(groups=groups, obstacles=ROOM, effects=(*routes, *lines), dt=0.02)
    state, least = scene.start(0), np.inf
    state.pos[0] = ((1, 3), (6, 3), (4.5, 4.5))
    for _ in range(80):
        scene.step(state, out=state, steps=10)
        least = min(least, float(state.pos[0, 1, 0] - state.pos[0, 0, 0]))
    np.testing.assert_allclose(state.pos[0, 0], (5.5, 3), atol=0.01)
    np.testing.assert_array_equal(state.pos[0, 1:], ((6, 3), (4.5, 4.5)))
    assert least > 0.5 - 1e-6


def passing(second: Group, both: bool) -> Array:
    """Return the paths of an agent that walks from -4 to 4 m and of a second one, which walks back if `both`."""
    give = UnalignedAvoidance(weight=120.0, radius=4.0, horizon=2.0, margin=0.1)
    ways = (
        Way(group=0, targets=(Target(at=(-30, 0)), Target(at=(4, 0))), slow_radius=0.5),
        Way(group=1, targets=(Target(at=(30, 0)), Target(at=(-4, 0))), slow_radius=0.5, share=float(both)),
    )
    steers = (Steer(group=0, behaviours=(Driving(), give)), Steer(group=1, behaviours=(Driving(), give)))
    scene = Scene(groups=(walkers(1, (-4, 0), (-4, 0)), second), effects=(*ways, *steers), dt=0.02)
    state, path = scene.start(0), []
    for _ in range(700):
        scene.step(state, out=state)
        path.append(state.pos[0].copy())
    return np.array(path)


@pytest.mark.slow
def test_a_standing_agent_is_passed_and_two_agents_head_on_both_keep_right() -> None:
    """JuPedSim's T4 and T12: no overlap; the standing agent stays; the two paths head-on are mirror images."""
    path = passing(walkers(1, (0, 0), (0, 0), max_force=0), both=False)
    assert np.linalg.norm(path[:, 0] - path[:, 1], axis=1).min() > 0.4
    np.testing.assert_array_equal(path[:, 1], 0)
    np.testing.assert_allclose(path[-1, 0], (4, 0), atol=0.01)
    path = passing(walkers(1, (4, 0), (4, 0)), both=True)
    assert np.linalg.norm(path[:, 0] - path[:, 1], axis=1).min() > 0.4
    assert np.abs(path.sum(axis=1)).max() < 0.005
    np.testing.assert_allclose(path[-1], ((4, 0), (-4, 0)), atol=0.01)
    middle = np.argmin(np.abs(path[:, 0, 0]))
    assert path[middle, 0, 1] < -0.1  # the agent from the left passes on its right


# --- refusals ---------------------------------------------------------------------------------------------------------

DOOR = Door(ends=LEFT)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Target(), "at: give one of at, ends, or low and high"),
        (lambda: Target(at=(1, 1), low=(0, 0), high=(1, 1)), "at: give one of"),
        (lambda: Target(low=(0, 2), high=(1, 1)), r"low = \(0.0, 2.0\): must not be above high"),
        (lambda: Target(ends=((0, 2), (0, 2))), "is a point; give at"),
        (lambda: Stage(at=(1, 1)), "radius = 0: must be above 0"),
        (lambda: Door(at=(1, 1), radius=1), "width = None: must be given, in m, for a door without ends"),
        (lambda: Way(targets=()), "targets: must be a list of at least 1"),
        (lambda: Journey(stages=()), "stages: must be a list of at least 1"),
        (lambda: Routes(doors=()), "doors: must be a list of at least 1"),
        (
            lambda: Way(targets=(Target(at=(0, 1)),)),
            r"targets\[0\] = \(0.0, 1.0\): is -0.1 m from an obstacle",
        ),
        (
            lambda: Way(targets=(Target(at=(3, 3)), Target(ends=((0, 0), (0, 1))))),
            r"targets\[1\] = .*: is at most -0.1 m",
        ),
        (
            lambda: Way(targets=(Target(at=(1, 2, 3)),)),
            r"targets\[0\] = \(1.0, 2.0, 3.0\): lies in 3 dimensions, but dimension = 2",
        ),
        (lambda: Way(targets=(Target(at=(3, 3)),), clearance=0.1, spacing=0.5), "spacing = 0.5: paths lead through"),
        (lambda: Way(targets=(Target(at=(3, 3)),), group=4), "group = 4: there are 1 groups"),
        (
            lambda: Way(targets=(Target(at=(12, 3)),), clearance=1.0),
            r"targets\[0\] = \(12.0, 3.0\): no way leads",
        ),
        (lambda: Way(targets=(Target(at=(3, 3)),), spacing=1e-4), "points; at most"),
        (lambda: Journey(stages=(Stage(at=(5, 0), radius=0.1),)), r"stages\[0\] = \(5.0, 0.0\): is -0.1 m"),
        (lambda: Routes(doors=(DOOR, Door(ends=((0, 0), (0, 1))))), r"doors\[1\] = .*: is at most -0.1 m"),
    ],
)
def test_invalid_targets_and_floor_fields_are_refused_in_one_line(make: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text) as error:
        Scene(groups=(walkers(2, (2, 2), (3, 3)),), obstacles=ROOM, effects=(make(),))
    assert "\n" not in str(error.value)


def test_two_aims_of_one_group_and_door_choice_without_a_speed_are_refused() -> None:
    groups = (walkers(2, (2, 2), (3, 3)), walkers(2, (2, 2), (3, 3)))
    with pytest.raises(ValueError, match=r"effects\[0\].group = 0: effects\[1\], a routes, also steers some"):
        Scene(groups=groups, obstacles=ROOM, effects=(THERE, Routes(doors=(DOOR,))))
    slow = Group(count=1, spawn=Spawn(low=(2, 2), high=(3, 3)))
    with pytest.raises(ValueError, match=r"groups\[0\].desired_speed = None: must be given, in m/s"):
        Scene(groups=(slow,), obstacles=ROOM, effects=(Routes(doors=(DOOR,)),))


def thin(x: float = 5.0, wide: float = 0.05) -> Polygon:
    return Polygon(vertices=((x, 0), (x + wide, 0), (x + wide, 5), (x, 5)))


@pytest.mark.parametrize(
    ("shapes", "clearance", "part"),
    [
        ((thin(),), 0.0, r"obstacles\[0\], 0.05 m thick, unless a clearance of more than 0.075 m or a spacing of less"),
        ((thin(),), 0.01, "unless a clearance of more than 0.075 m"),
        (tuple(Circle(centre=(5, 0.06 + 0.12 * k), radius=0.06) for k in range(40)), 0.0, "0.12 m thick"),
        ((Wall(vertices=((5, 0), (5, 5))),), 0.0, r"clearance = 0: paths lead through obstacles\[0\], which is a line"),
        ((Block(centre=(5, 2.5), size=(0.1, 5)),), 0.04, "0.1 m thick"),
    ],
)
def test_obstacles_thinner_than_the_grid_resolves_are_refused(shapes: Any, clearance: float, part: str) -> None:
    people = walkers(1, (1, 1), (1, 1))
    with pytest.raises(ValueError, match=part) as error:
        Scene(
            space=Box(size=(10, 6)), groups=(people,), obstacles=shapes,
            effects=(Way(targets=(Target(at=(9, 1)),), clearance=clearance),),
        )  # fmt: skip
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("shape", "thick"),
    [
        (thin(wide=0.4), 0.4), (Polygon(vertices=((0, 0), (4, 0), (0, 3))), 2.4), (Circle(centre=(0, 0), radius=2), 4),
        (Polygon(vertices=((0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4))), 0), (Block(centre=(0, 0), size=(3, 1)), 1),
        (HalfSpace(point=(0, 0), direction=(1, 0)), math.inf),
        (Wall(vertices=((0, 0), (1, 0)), radius=0.1), 0.2),
    ],
)  # fmt: skip
def test_the_thickness_of_a_shape_is_that_of_its_thinnest_place(shape: Any, thick: float) -> None:
    assert shape.thickness == pytest.approx(thick)
