"""Unaligned avoidance, queues, foraging and coverage: required properties, and closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv import steering
from flockenv.behaviours import (
    AvoidObstacles,
    Explore,
    Forage,
    Orca,
    Queue,
    Separation,
    StayOnPath,
    UnalignedAvoidance,
)
from flockenv.behaviours.steer import Steer
from flockenv.geometry.space import Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.steering.arbitration import Allocation
from flockenv.steering.vectorize import rows
from tests.catalogue import Array

threat, give_way = rows(steering.unaligned_threat), rows(steering.give_way)
queue_gap, queue, explore = rows(steering.queue_gap), rows(steering.queue), rows(steering.explore)
SPAWN = Spawn(low=(0, 0), high=(1, 1))


# --- neighbours on a collision course, in closed form -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("offset", "other", "clearance", "seconds"),
    [
        ((6, 0), (-1, 0), 1.0, 3.0),  # head-on
        ((6, 0.9), (-1, 0), 1.0, 3.0),
        ((6, 1.1), (-1, 0), 1.0, math.inf),  # passes by
        ((3, -3), (0, 1), 1.0, 3.0),  # crossing, in the same place at the same time
        ((3, -4.5), (0, 1), 1.1, 3.75),  # crossing behind: nearest at 1.06 m
        ((3, -4.5), (0, 1), 1.0, math.inf),
        ((2, 0), (0.5, 0), 1.0, 4.0),  # catching up
        ((-2, 0), (0.5, 0), 1.0, math.inf),  # already past
        ((2, 0), (1, 0), 3.0, math.inf),  # at the same velocity: never nearer than now
        ((20, 0), (-1, 0), 1.0, math.inf),  # later than the horizon
    ],
)
def test_a_threat_has_the_time_of_closest_approach(offset: Any, other: Any, clearance: float, seconds: float) -> None:
    assert threat(offset, (1.0, 0.0), other, clearance, 5.0) == pytest.approx(seconds)


def test_a_threat_is_found_by_the_sum_of_both_radii() -> None:
    """With twice its own radius a small agent would run into a large one."""
    for own, other in ((0.1, 0.9), (0.9, 0.1)):
        assert np.isfinite(threat((6.0, 0.95), (1.0, 0.0), (-1.0, 0.0), own + other, 5.0))
    assert threat((6.0, 0.95), (1.0, 0.0), (-1.0, 0.0), 2 * 0.1, 5.0) == np.inf


def meeting(offset: Any, mine: Any, other: Any) -> tuple[Array, Array]:
    """Return the steering of two agents that avoid each other."""
    o, v, w = (np.asarray(a, float) for a in (offset, mine, other))
    time = threat(o, v, w, 99.0, 99.0)
    return give_way(o, v, w, time, 1.0), give_way(-o, w, v, time, 1.0)


def test_two_agents_steer_in_opposite_directions_even_if_their_centres_would_meet() -> None:
    rng = np.random.default_rng(0)
    v, w, t = rng.normal(size=(200, 2)), rng.normal(size=(200, 2)), rng.uniform(1, 4, (200, 1))
    for miss in (0.0, 0.2):
        first, second = meeting((v - w) * t + miss * rng.normal(size=(200, 2)), v, w)
        np.testing.assert_allclose(first, -second, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1)
        np.testing.assert_allclose((first * (v - w)).sum(axis=1), 0, atol=1e-4)  # across the relative motion


def test_head_on_both_agents_keep_right_and_do_not_brake() -> None:
    first, second = meeting((6, 0), (1, 0), (-1, 0))
    np.testing.assert_allclose([first, second], [[0, -1], [0, 1]], atol=1e-12)


def test_of_two_crossing_agents_one_brakes_and_one_speeds_up() -> None:
    """The agent on the other's right goes first; the other turns towards its rear and brakes."""
    behind, ahead = meeting((3, -3), (1, 0), (0, 1))
    np.testing.assert_allclose(behind, [-math.sqrt(0.5), -math.sqrt(0.5)], atol=1e-12)
    np.testing.assert_allclose(ahead, [math.sqrt(0.5), math.sqrt(0.5)], atol=1e-12)
    first, second = meeting((3, -3.5), (1, 0), (0, 1))  # the second would be late, so the first passes in front
    assert first[0] > 0
    assert second[1] < 0


def test_agents_that_converge_from_the_side_brake_or_speed_up() -> None:
    """Their paths are almost parallel: turning right would lead one of them into the other."""
    first, second = meeting((0.3, -2), (1, 0.1), (1, 0.2))
    np.testing.assert_allclose([first, second], [[-1, 0], [1, 0]], atol=1e-12)


# --- giving way, and queues, in a scene -------------------------------------------------------------------------------

OFF = {"give_way": 0.0, "avoid": 0.0, "apart": 0.0}


def crowd(
    groups: tuple[Group, ...],
    targets: Any,
    obstacles: Any = (),
    yielding: int = 2,
    behind: Any = (0, 1),
    **given: float,
) -> Scene:
    """Return a scene of two groups with a target each; tests of avoidance and of queues share its kernel."""
    p = OFF | {"queue": 4.0, "speed": 1.2, "headway": 1.0, "margin": 0.1} | given
    steers = [
        Steer(
            group=k, arbitration=Allocation(),
            behaviours=(
                AvoidObstacles(weight=p["avoid"], horizon=1.2, margin=0.1),
                UnalignedAvoidance(weight=p["give_way"] * (k < yielding), radius=20, horizon=4, margin=p["margin"]),
                Separation(weight=p["apart"], radius=0.9),
                Queue(
                    weight=p["queue"], target=target, speed=p["speed"], headway=p["headway"], margin=p["margin"],
                    group=behind[k],
                ),
            ),
        )
        for k, target in enumerate(targets)
    ]  # fmt: skip
    return Scene(dimension=2, space=Torus(size=(400, 400)), groups=groups, obstacles=obstacles, effects=steers, dt=0.05)


def bodies(count: int, radius: float = 0.3, **limits: float) -> Group:
    return Group(count=count, radius=radius, spawn=SPAWN, **({"max_force": 5.0} | limits))


def placed(scene: Scene, pos: Any, vel: Any) -> State:
    start = scene.start(0)
    start.pos[0], start.vel[0] = np.asarray(pos, float), np.asarray(vel, float)
    return start


def played(scene: Scene, state: State, steps: int) -> tuple[Array, Array]:
    """Return positions and velocities after every step, (steps + 1, N, 2)."""
    pos, vel = [state.pos[0].copy()], [state.vel[0].copy()]
    for _ in range(steps):
        state = scene.step(state)
        pos.append(state.pos[0].copy())
        vel.append(state.vel[0].copy())
    return np.array(pos), np.array(vel)


def least_gap(scene: Scene, pos: Array) -> float:
    """Return the smallest gap between two bodies at any time, m."""
    own = scene.body.radius
    apart = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1) - own - own[:, None]
    return float((apart + np.diag(np.full(len(own), np.inf))).min())


MEETINGS = {  # positions and velocities about (100, 100); the targets lie far ahead
    "head-on": (((-6, 0), (6, 0)), ((1.2, 0), (-1.2, 0))),
    "crossing": (((-6, 0), (0, -6)), ((1.2, 0), (0, 1.2))),
    "catching up": (((-6, 0), (-2, 0)), ((1.2, 0), (0.4, 0))),
    "converging": (((-6, 0), (-6, 2.4)), ((1.2, 0.2), (1.2, -0.2))),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", MEETINGS)
@pytest.mark.parametrize("radii", [(0.3, 0.3), (0.1, 0.9), (0.9, 0.1)])
def test_two_agents_on_a_collision_course_do_not_collide(case: str, radii: tuple[float, float]) -> None:
    pos, vel = (np.array(a, float) for a in MEETINGS[case])
    targets = tuple(tuple(map(float, 100 + x + 60 * v)) for x, v in zip(pos, vel, strict=True))
    groups = tuple(bodies(1, radius=r, max_speed=2.0) for r in radii)
    speeds = {} if case != "catching up" else {"queue": 0.0}
    gaps = []
    for weight in (0.0, 4.0):
        scene = crowd(groups, targets, give_way=weight, **speeds)
        moved, _ = played(scene, placed(scene, 100 + pos, vel), 240)
        gaps.append(least_gap(scene, moved))
    assert gaps[0] < -0.2, "they collide if neither gives way"
    assert gaps[1] > 0


@pytest.mark.slow
def test_a_small_agent_gives_way_to_a_large_one() -> None:
    """It would miss the other's centre by 0.8 m: more than twice its own radius, less than the sum of both."""
    for weight, clear in ((0.0, False), (4.0, True)):
        groups = (bodies(1, radius=0.1), bodies(1, radius=0.9))
        scene = crowd(groups, ((172.0, 100.0), (100.0, 100.8)), give_way=weight, yielding=1)
        pos, _ = played(scene, placed(scene, [(94, 100), (100, 100.8)], [(1.2, 0), (0, 0)]), 200)
        assert (least_gap(scene, pos) > 0) == clear
        np.testing.assert_array_equal(pos[-1, 1], (100, 100.8))


@pytest.mark.slow
def test_the_agent_that_passes_behind_slows_down_and_the_first_does_not() -> None:
    pos, vel = (np.array(a, float) for a in MEETINGS["crossing"])
    scene = crowd((bodies(1), bodies(1)), ((172.0, 100.0), (100.0, 172.0)), give_way=4.0)
    _, moved = played(scene, placed(scene, 100 + pos, vel), 150)
    speed = np.linalg.norm(moved, axis=-1)
    assert speed[:, 0].min() < 1.1
    assert speed[:, 1].min() > 1.19


def test_a_gap_in_a_queue_is_the_free_distance_to_a_slower_neighbour_ahead() -> None:
    way = (1.0, 0.0)
    gaps = queue_gap(way, [(5, 0), (5, 0.6), (5, 1.01), (-5, 0), (5, 0)], (0.5, 0.0), 1.0, [1.2, 1.2, 1.2, 1.2, 0.4])
    np.testing.assert_allclose(gaps, [4, 5 - 0.8, np.inf, np.inf, np.inf])  # beside; behind; not slower
    np.testing.assert_allclose(
        queue(way, (0.2, 0.1), [0.5, np.inf, 0.0], 1.2, 1.0), [[0.3, -0.1], [1.0, -0.1], [-0.2, -0.1]]
    )


def file_of(count: int, **given: float) -> tuple[Scene, State]:
    """Return a file of agents at rest, with gaps of 0.6 m; group 1 is one agent far away."""
    scene = crowd((bodies(count), bodies(1)), ((160.0, 100.0), (160.0, 100.0)), **given)
    x = 100 - 1.2 * np.arange(count)
    return scene, placed(scene, [*((a, 100.0) for a in x), (50.0, 50.0)], [(0.0, 0.0)] * (count + 1))


def test_a_queue_flows_at_its_headway_and_never_overlaps() -> None:
    """Tordeux et al. 2016: gaps at speed v are v T, so 1 / (T + l / v) agents pass per second; here at full speed.

    Nothing holds up the first agent. Gaps behind it widen to speed x headway + margin.
    """
    scene, start = file_of(8)
    pos, vel = played(scene, start, 600)
    gaps = pos[:, :7, 0] - pos[:, 1:8, 0] - 0.6
    assert gaps.min() >= 0.1
    np.testing.assert_allclose(vel[-1, :8], np.tile([1.2, 0.0], (8, 1)), atol=0.02)
    assert (gaps[-1] >= 1.2 * 1.0 + 0.1 - 0.05).all()
    at = 115.0
    passed = np.sort([np.argmax(pos[:, k, 0] > at) * scene.dt for k in range(8)])
    flow = 7 / (passed[-1] - passed[0])
    assert flow == pytest.approx(1 / (1.0 + (0.6 + 0.1) / 1.2), rel=0.1)


def test_a_queue_stops_behind_a_stopped_agent_and_closes_up_to_the_margin() -> None:
    """With a gain of 4 m / T the motion is critically damped, so a gap closes to the margin and never beyond it."""
    scene, start = file_of(4, queue=4.0)
    stone = np.array([110.0, 100.0])  # the first agent is held here
    start.pos[0, 0] = stone
    for _ in range(800):
        start = scene.step(start)
        start.pos[0, 0], start.vel[0, 0] = stone, 0.0
        gaps = start.pos[0, :3, 0] - start.pos[0, 1:4, 0] - 0.6
        assert gaps.min() >= 0.1 - 1e-9
    np.testing.assert_allclose(gaps, 0.1, atol=0.01)
    assert np.abs(start.vel[0, :4]).max() < 0.01


@pytest.mark.slow
def test_a_gap_in_a_queue_takes_the_radii_of_both_bodies() -> None:
    """A small agent stops one margin behind a standing large one."""
    small, large = bodies(1, radius=0.1), bodies(1, radius=0.9)
    scene = crowd((small, large), ((160.0, 100.0), (160.0, 100.0)), behind=(1, 1), queue=4.0)
    state = placed(scene, [(100.0, 100.0), (106.0, 100.0)], [(0.0, 0.0), (0.0, 0.0)])
    for _ in range(400):
        state = scene.step(state)
        state.pos[0, 1], state.vel[0, 1] = (106.0, 100.0), 0.0
    assert 106.0 - state.pos[0, 0, 0] == pytest.approx(0.1 + 0.9 + 0.1, abs=0.01)


def test_a_queue_passes_a_door_without_contact() -> None:
    """A gap of 1.4 m between two round pillars, 12 bodies of 0.5 m: all are through in 30 s."""
    stones = ({"centre": (100.0, 102.7), "radius": 2.0}, {"centre": (100.0, 97.3), "radius": 2.0})
    scene = crowd(
        (bodies(12, radius=0.25, max_force=8.0), bodies(1)), ((130.0, 100.0), (50.0, 50.0)), stones,
        avoid=6.0, apart=2.0, queue=3.0, speed=1.3,
    )  # fmt: skip
    begin = [(96.0 - 0.9 * i, 98.65 + 0.9 * j) for i in range(3) for j in range(4)]
    pos, _ = played(scene, placed(scene, [*begin, (50, 50)], [(0, 0)] * 13), 600)
    own = pos[:, :12]
    apart = np.linalg.norm(own[:, :, None] - own[:, None], axis=-1) + np.diag(np.full(12, np.inf))
    assert apart.min() >= 0.5
    for stone in scene.obstacles:
        assert np.linalg.norm(own - stone.centre, axis=-1).min() >= stone.radius + 0.25
    assert (own[-1, :, 0] > 101).all()
    passed = np.argmax(own[:, :, 0] > 100, axis=0) * scene.dt
    assert 11 / (passed.max() - passed.min()) > 0.8  # agents per second


def test_on_a_torus_a_queue_heads_for_the_nearest_image_of_its_target() -> None:
    scene = crowd((bodies(1), bodies(1)), ((3.0, 100.0), (50.0, 50.0)))
    end = scene.run(placed(scene, [(398, 100), (50, 50)], [(0, 0), (0, 0)]), 20)
    assert end.vel[0, 0, 0] > 0.5


# --- forage -----------------------------------------------------------------------------------------------------------


def meadow(dt: float = 0.05, **given: float) -> Scene:
    fields: dict[str, Any] = {"weight": 3.0, "food": 1, "speed": 1.2, "radius": 2.5} | given
    groups = (Group(count=2, radius=0.2, spawn=SPAWN), Group(count=3, radius=0.1, spawn=SPAWN))
    return Scene(dimension=2, groups=groups, effects=(Steer(group=0, behaviours=(Forage(**fields),)),), dt=dt)


FOOD = [(0.0, 1.5), (2.0, 0.0), (60.0, 60.0)]


def test_a_forager_goes_to_the_nearest_food_in_sight_and_stays() -> None:
    scene = meadow()
    end = scene.run(placed(scene, [(0, 0), (58, 60), *FOOD], [(0.3, 0), (0, 0), (0, 0), (0, 0), (0, 0)]), 300)
    np.testing.assert_allclose(end.pos[0, 0], FOOD[0], atol=0.01)
    np.testing.assert_allclose(end.pos[0, 1], FOOD[2], atol=0.01)
    np.testing.assert_array_equal(end.pos[0, 2:], FOOD)  # food does not move


def test_without_food_in_sight_agents_wander_along_paths_independent_of_dt() -> None:
    ends = []
    for dt in (0.05, 0.025, 0.0125):
        scene = meadow(dt)
        vel = [(1, 0), (0, 1), (0, 0), (0, 0), (0, 0)]
        start = placed(scene, [(20, 20), (30, 20), *FOOD], vel)
        pos, _ = played(scene, start, round(6 / dt))
        ends.append(pos[-1, :2])
    assert (
        np.linalg.norm(ends[1] - ends[2], axis=1).max() < 0.6 * np.linalg.norm(ends[0] - ends[1], axis=1).max() + 0.02
    )
    assert np.linalg.norm(ends[0] - ends[2], axis=1).max() < 0.4
    straight = np.array([(20 + 6 * 1.2, 20), (30, 20 + 6 * 1.2)])
    assert (np.linalg.norm(ends[2] - straight, axis=1) > 0.3).all()  # both turn, differently
    assert not np.allclose(ends[2][0] - straight[0], (ends[2][1] - straight[1])[::-1], atol=0.1)


# --- explore ----------------------------------------------------------------------------------------------------------


def sweep(x: Array, seconds: float, width: float = 12.0, height: float = 9.0, track: float = 1.5) -> Array:
    """Return the paths of exploring agents of 1 kg with at most 1 m/s and 2 N, at a gain of 5 kg/s."""
    v, path = np.zeros_like(x), [x]
    for _ in range(round(seconds / 0.05)):
        force = 5 * explore(x, np.array([width, height]) - x, v, 1.0, track)
        size = np.linalg.norm(force, axis=1, keepdims=True)
        v = v + 0.05 * force * np.minimum(1, 2 / np.maximum(size, 1e-9))
        x = x + 0.05 * v
        path.append(x)
    return np.array(path)


def test_explore_covers_the_whole_region_in_one_round_from_any_start() -> None:
    """A closed comb of 6 rows is 6 (12 - 2 x 1.5) + 2 x 9 = 72 m long; some corners are cut."""
    begun = np.random.default_rng(0).uniform(0, 1, (6, 2)) * [12, 9]
    path = sweep(begun, 1.25 * 72)
    places = np.stack(np.meshgrid(np.linspace(0, 12, 49), np.linspace(0, 9, 37)), axis=-1).reshape(-1, 2)
    for k in range(len(begun)):
        seen = np.zeros(len(places), bool)
        for here in path[::4, k]:
            seen |= np.linalg.norm(places - here, axis=1) < 1.25 * 1.5
        assert seen.all()
    assert path.min() >= 0
    assert (path <= [12, 9]).all()


@pytest.mark.parametrize(
    ("effect", "space", "message"),
    [
        (Explore(weight=1, low=(0, 0), high=(9, 9), speed=1, track=1), Torus(size=(9, 9)), "of kind 'torus'"),
        (Explore(weight=1, low=(0, 0), high=(9, 2), speed=1, track=1), None, "must be at least 3 tracks = 3 m"),
        (Forage(weight=1, food=2, speed=1), None, "food = 2: there are 1 groups, counted from 0"),
        (
            Queue(weight=1, target=(0, 0, 0), speed=1),
            None,
            "target = (0.0, 0.0, 0.0): has 3 numbers, but dimension = 2",
        ),
        (Queue(weight=1, target=(0, 0)), None, "speed = None: groups[0].max_speed is not given"),
        (Forage(weight=1, food=0), None, "speed = None: groups[0].max_speed is not given"),
        (Explore(weight=1, low=(0, 0), high=(9, 9), track=1), None, "speed = None: groups[0].max_speed is not given"),
        (Orca(weight=1, target=(0, 0)), None, "speed = None: groups[0].max_speed is not given"),
        (
            StayOnPath(weight=1, points=((0, 0), (1, 0)), radius=1),
            None,
            "speed = None: groups[0].max_speed is not given",
        ),
    ],
)
def test_a_behaviour_that_does_not_fit_its_scene_is_refused_in_one_line(effect: Any, space: Any, message: str) -> None:
    given = {} if space is None else {"space": space}
    with pytest.raises(ValueError, match=r".") as caught:
        Scene(dimension=2, groups=(bodies(2),), effects=(effect,), **given)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
