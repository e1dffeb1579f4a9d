"""Path following, staying on a path, flow-field following: closed forms, and what others get wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from flockenv.behaviours import FollowFlow, FollowPath, StayOnPath
from flockenv.behaviours.crowd import UnalignedAvoidance
from flockenv.behaviours.steer import Steer
from flockenv.geometry import polyline
from flockenv.geometry.space import Plane, Space, Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import load_scene
from tests.catalogue import Array

NOBODY = Spawn(low=(0.0, 0.0), high=(1.0, 1.0))
RING_RADIUS = 10.0


def ring(pieces: int = 240, radius: float = RING_RADIUS) -> tuple[tuple[float, float], ...]:
    """A circle of many short pieces, counterclockwise."""
    angles = 2 * np.pi * np.arange(pieces) / pieces
    return tuple(zip((radius * np.cos(angles)).tolist(), (radius * np.sin(angles)).tolist(), strict=True))


def traffic(*follow: FollowPath, apart: float = 0.0, counts: tuple[int, ...] = (1,), **fields: Any) -> Scene:
    """A group for each way of a path, or one of them idle: one kernel for all tests of path following in the plane."""
    both = follow if len(follow) == 2 else (follow[0], follow[0].idle())
    each = counts if len(counts) == 2 else (counts[0], 1)
    groups = tuple(
        Group(count=n, mass=1.0, radius=0.2, max_speed=2.0, max_force=fields.pop("max_force", 20.0), spawn=NOBODY)
        for n in each
    )
    steer = tuple(
        Steer(group=g, behaviours=(UnalignedAvoidance(weight=apart, horizon=1.5, margin=0.2), path))
        for g, path in enumerate(both)
    )
    return Scene(groups=groups, effects=steer, **({"dt": 0.02} | fields))


def begun(scene: Scene, places: Any, velocities: Any) -> State:
    """Everybody else far away and at rest."""
    state = scene.start(0)
    state.pos[0], state.vel[0] = -500.0, 0.0
    state.pos[0, :, 0] -= 50.0 * np.arange(scene.agents)
    state.pos[0, : len(places)], state.vel[0, : len(places)] = places, velocities
    return state


def push(scene: Scene, place: Any, velocity: Any) -> Array:
    """What the first agent of a scene asks for, N."""
    return np.asarray(scene.acceleration(begun(scene, [place], [velocity]))[0, 0])


STRAIGHT = FollowPath(weight=4, points=((0, 0), (20, 0)), radius=1, speed=2, time=0.5, keep=0)


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_path_knows_its_nearest_point_and_every_length(closed: bool, dimension: int) -> None:
    """Against ten thousand points along it."""
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 10, (7, dimension))
    path = polyline.pieces(points.tolist(), closed)
    corners = np.vstack([points, points[:1]]) if closed else points
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    assert path[1] == pytest.approx(lengths[-1])
    s = np.linspace(0, lengths[-1], 10_001)
    dense = np.stack([np.interp(s, lengths, corners[:, k]) for k in range(dimension)], axis=1)
    np.testing.assert_allclose(polyline.on_spine(path, s, dimension), dense, atol=1e-12)
    beyond = polyline.on_spine(path, [-1.0, lengths[-1] + 1], dimension)
    expected = polyline.on_spine(path, [lengths[-1] - 1, 1.0], dimension) if closed else corners[[0, -1]]
    np.testing.assert_allclose(beyond, expected, atol=1e-12)
    places = rng.uniform(-3, 13, (200, dimension))
    found, offset = polyline.projected(path, places)
    gaps = np.linalg.norm(places[:, None] - dense, axis=2)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), gaps.min(axis=1), atol=3e-3)
    np.testing.assert_allclose(polyline.on_spine(path, found, dimension), places + offset, atol=1e-12)


def test_on_a_torus_a_path_goes_the_shortest_way_and_so_do_offsets() -> None:
    path = polyline.pieces([(2, 5), (9, 5), (16, 5)], True, Torus(size=(20, 12)))
    assert path[1] == pytest.approx(20)
    found, offset = polyline.projected(path, [(19, 6), (1, 11.5), (39.5, -7.5)])
    np.testing.assert_allclose(found, [17, 19, 17.5])
    np.testing.assert_allclose(offset, [(0, -1), (0, 5.5), (0, 0.5)], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"points": ((0.0, 0.0), (1.0, 0.0, 0.0))}, r"points\[1\] = .*: the first point has 2 coordinates"),
        ({"points": ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0))}, r"points\[2\] = .*: is where the one before it is"),
        ({"points": ((0.0, 0.0), (1.0, 0.0)), "closed": True}, "a closed path has at least 3"),
        ({"points": ((0.0, 0.0), (1.0, 0.0), (0.0, 0.0)), "closed": True}, r"points\[0\] = .*: is where the one"),
        ({"way": 0}, "way"),
        ({"time": 0.0}, "time"),
    ],
)
def test_what_is_no_path_is_refused_in_one_line(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        FollowPath(**{**STRAIGHT.model_dump(), **change})
    assert "\n" not in str(caught.value)


def test_a_path_has_the_dimension_of_its_scene() -> None:
    flat = Group(count=1, spawn=Spawn(low=(0, 0, 0), high=(1, 1, 1)))
    with pytest.raises(ValueError, match=r"effects\[0\]\.points\[0\] = .*: dimension = 3"):
        Scene(dimension=3, groups=(flat,), effects=(STRAIGHT,))


# --- path following ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_on_its_way_in_the_tube_it_is_let_alone() -> None:
    """Exactly 0 where the predicted place is in the tube and further along; in the wrong direction it is not."""
    there, back = traffic(STRAIGHT), traffic(STRAIGHT.model_copy(update={"way": -1}))
    for place, velocity in [((5, 0.5), (1, 0.5)), ((3, -0.9), (0.1, 0)), ((0.2, 0), (2, 0))]:
        assert not push(there, place, velocity).any()
        wrong_way = push(back, place, velocity)
        assert wrong_way[0] < 0
        np.testing.assert_allclose(push(back, place, -np.array(velocity)) == 0, True)


def test_who_would_leave_the_tube_seeks_the_spine_ahead() -> None:
    """The closed form: S = V unit(spine(s + T |v|) - x) - v, at the speed that it has."""
    x, v = np.array([4.0, 0.8]), np.array([1.0, 1.0])
    target = np.array([4 + 0.5 * math.sqrt(2), 0.0])
    wish = 2 * (target - x) / np.linalg.norm(target - x) - v
    np.testing.assert_allclose(push(traffic(STRAIGHT), x, v), 4 * wish, rtol=1e-12)


def test_who_stands_is_sent_on() -> None:
    """At standstill a look ahead of T |v| is none: on the spine it would stand for ever."""
    for place in ((5.0, 0.0), (5.0, 0.4), (0.0, 0.0)):
        assert push(traffic(STRAIGHT), place, (0, 0))[0] > 1.0
    assert push(traffic(STRAIGHT.model_copy(update={"way": -1})), (5.0, 0.0), (0, 0))[0] < -1.0


def test_who_is_slower_than_it_should_be_is_sent_on() -> None:
    """Reynolds' rule lets alone who has just begun to move: it would coast for ever at a hundredth of its speed."""
    for keep, fast in ((0.0, 0.5), (0.8, 1.5)):
        scene = traffic(STRAIGHT.model_copy(update={"keep": keep}))
        end = scene.run(begun(scene, [(1, 0)], [(0, 0)]), 300)
        assert (end.vel[0, 0, 0] > fast) == (keep > 0)


def test_on_a_circle_it_flies_on_the_orbit_of_the_closed_form() -> None:
    """A tube of no width: always the point L = T |v| ahead on the ring is sought, and the orbit r is where
    m v^2 / r = w V sin a and v = V cos a, with a the angle of that point to the tangent, below it.
    """  # one formula
    weight, top, time = 6.0, 2.0, 0.8
    path = FollowPath(weight=weight, points=ring(), closed=True, radius=1e-9, speed=top, time=time)
    scene = traffic(path, max_force=None, dt=0.004)
    end = scene.run(begun(scene, [(RING_RADIUS, 0)], [(0, top)]), 12_000)

    def excess(r: float) -> float:
        speed = top
        for _ in range(50):  # L depends on the speed, the speed on L
            turn = time * speed / RING_RADIUS
            angle = math.atan2(r - RING_RADIUS * math.cos(turn), RING_RADIUS * math.sin(turn))
            speed = top * math.cos(angle)
        return weight * top * math.sin(angle) - speed**2 / r

    orbit = brentq(excess, 0.8 * RING_RADIUS, 1.2 * RING_RADIUS)
    assert abs(orbit - RING_RADIUS) > 0.001  # it is not the ring itself
    assert np.linalg.norm(end.pos[0, 0]) - RING_RADIUS == pytest.approx(orbit - RING_RADIUS, abs=2e-3)


def test_on_a_circle_it_stays_in_the_tube_and_goes_round_and_round() -> None:
    """Two laps; across the seam nothing pushes, the tube is never left by more than the turn that brings it back."""
    path = FollowPath(weight=20, points=ring(), closed=True, radius=0.6, speed=2, time=0.4, keep=0.8)
    scene = traffic(path)
    state = begun(scene, [(RING_RADIUS, -1.0)], [(0, 2)])
    out, angles = [], []
    for _ in range(480):
        state = scene.step(state, steps=10)
        out.append(abs(np.linalg.norm(state.pos[0, 0]) - RING_RADIUS))
        angles.append(math.atan2(state.pos[0, 0, 1], state.pos[0, 0, 0]))
    assert max(out) < 0.6
    assert max(out) > 0.3  # it does not cling to the spine: in the tube nothing holds it
    turned = np.unwrap(angles)
    assert (np.diff(turned) > 0).all()
    assert turned[-1] - turned[0] > 2 * 2 * np.pi
    assert not push(scene, (RING_RADIUS, -0.3), (0, 2)).any()  # in half a second it is beyond the first point


def test_traffic_of_both_ways_passes() -> None:
    """Eight against eight in a tube of two metres, in the way of each other: all come round, and nobody is touched."""
    path = FollowPath(weight=5, points=ring(), closed=True, radius=1.0, speed=2, time=0.5, keep=0.9)
    scene = traffic(path, path.model_copy(update={"way": -1}), apart=10.0, counts=(8, 8))
    angle, away = 2 * np.pi * np.arange(16) / 16, RING_RADIUS + np.random.default_rng(0).uniform(-0.7, 0.7, 16)
    places = np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)
    order = np.concatenate([np.arange(0, 16, 2), np.arange(1, 16, 2)])
    state = begun(scene, places[order], np.zeros((16, 2)))
    turned, gap, out = [], np.inf, 0.0
    for _ in range(400):
        state = scene.step(state, steps=5)
        x = state.pos[0]
        turned.append(np.arctan2(x[:, 1], x[:, 0]))
        out = max(out, np.abs(np.linalg.norm(x, axis=1) - RING_RADIUS).max())
        gap = min(gap, np.linalg.norm(x[:, None] - x, axis=2)[~np.eye(16, dtype=bool)].min())
    way = np.unwrap(np.array(turned), axis=0)
    gone = (way[-1] - way[0]) * RING_RADIUS * np.repeat([1, -1], 8)
    assert gone.min() > 0.9 * 2.0 * 40.0 - 2.0  # they began at rest
    assert gap > 0.4  # both radii
    assert out < 1.2  # the tube, and what it takes to give way at its edge


def test_an_open_path_s_end_is_arrived_at() -> None:
    for way, goal, begin in ((1, (20.0, 0.0), (12.0, 0.3)), (-1, (0.0, 0.0), (8.0, -0.3))):
        path = STRAIGHT.model_copy(update={"way": way, "slow_radius": 3.0, "keep": 0.5})
        scene = traffic(path)
        state, beyond = begun(scene, [begin], [(0, 0)]), -np.inf
        for _ in range(100):
            state = scene.step(state, steps=10)
            beyond = max(beyond, way * (state.pos[0, 0, 0] - goal[0]))
        assert np.linalg.norm(state.pos[0, 0] - goal) < 0.01
        assert np.linalg.norm(state.vel[0, 0]) < 0.01
        assert beyond < 0.01


def test_it_does_not_depend_on_the_step() -> None:
    """The same way for dt and dt / 4, to the error of the method: to 2 cm after 24 m."""
    ends = []
    for dt, steps in ((0.008, 1500), (0.002, 6000)):
        path = FollowPath(weight=6, points=ring(), closed=True, radius=1e-9, speed=2, time=0.5)
        scene = traffic(path, dt=dt)
        ends.append(scene.run(begun(scene, [(9.0, 0)], [(0, 0)]), steps).pos[0, 0])
    np.testing.assert_allclose(*ends, atol=0.02)


def on_torus(path: Any) -> Scene:
    spawn = Spawn(low=(0.0, 0.0), high=(1.0, 1.0))
    return Scene(
        space=Torus(size=(20, 12)), groups=(Group(count=1, max_speed=2, max_force=20, spawn=spawn),), effects=(path,),
        dt=0.02,
    )  # fmt: skip


@pytest.mark.slow
def test_on_a_torus_a_path_may_go_round_it() -> None:
    path = FollowPath(weight=5, points=((2, 11.5), (9, 11.5), (16, 11.5)), closed=True, radius=0.3, speed=2, time=0.5)
    scene = on_torus(path)
    state = scene.start(0)
    state.pos[0, 0], state.vel[0, 0] = (1.0, 1.0), (0, 0)
    gone = 0.0
    for _ in range(300):
        after = scene.step(state, steps=5)
        gone += float(scene.space.displacement(state.pos, after.pos)[0, 0, 0])
        state = after
    assert gone > 2.5 * 20
    assert abs(float(scene.space.displacement(state.pos, (0, 11.5))[0, 0, 1])) < 0.35


# --- stay on path -----------------------------------------------------------------------------------------------------


def kept(path: StayOnPath, count: int = 1, space: Space | None = None, **fields: Any) -> Scene:
    groups = (Group(count=count, max_speed=2, max_force=20, spawn=NOBODY),)
    return Scene(space=space or Plane(), groups=groups, effects=(path,), dt=0.02, **fields)


@pytest.mark.slow
def test_it_stays_in_the_tube_whichever_way() -> None:
    """Twenty from the spine in all directions; the closed form of a wish; nothing if the predicted place is inside."""
    path = StayOnPath(weight=6, points=((-100, 3), (100, 3)), radius=1, speed=2, time=0.5)
    scene = kept(path, 20)
    angle = 2 * np.pi * (np.arange(20) + 0.5) / 20
    state = begun(scene, np.tile([0.0, 3.0], (20, 1)), 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    ways = np.sign(state.vel[0, :, 0])
    out = 0.0
    for _ in range(100):
        state = scene.step(state, steps=10)
        out = max(out, np.abs(state.pos[0, :, 1] - 3).max())
    assert out < 1.0
    assert (np.sign(state.pos[0, :, 0]) == ways).all()  # it does not turn anybody round
    assert not push(scene, (5, 3.9), (-2, 0.1)).any()
    v = np.array([1.0, 1.0])
    wish = 2 * np.array([0.5, -0.9]) / math.hypot(0.5, 0.9) - v
    np.testing.assert_allclose(push(scene, (5, 3.9), v), 6 * wish, rtol=1e-12)


# --- flow-field following ---------------------------------------------------------------------------------------------

TURN = np.array([[-0.12, -0.24], [0.24, -0.12]])
"""A whirl: what is linear, a grid holds exactly."""


def whirl(time: float = 0.0, **fields: Any) -> FollowFlow:
    counts, spacing, centre = (9, 7), 2.5, np.array([5.0, 4.0])
    at = np.stack(np.meshgrid(*(spacing * (np.arange(n) - (n - 1) / 2) for n in counts), indexing="ij"), axis=-1)
    velocities = tuple(map(tuple, (at @ TURN.T).reshape(-1, 2).tolist()))
    given = {"weight": 3.0, "centre": tuple(centre.tolist()), "spacing": spacing, "counts": counts} | fields
    return FollowFlow(velocities=velocities, time=time, **given)


def flown(flow: FollowFlow, **fields: Any) -> Scene:
    groups = (Group(count=1, mass=1.5, spawn=NOBODY),)
    return Scene(groups=groups, effects=(flow,), **({"dt": 0.002} | fields))


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.0, 0.5])
def test_a_linear_field_is_followed_as_the_exact_solution_says(time: float) -> None:
    """m x'' = w (A (x + T v - c) - v), solved by a matrix exponential."""
    scene, centre = flown(whirl(time)), np.array([5.0, 4.0])
    x, v = np.array([9.0, 1.5]), np.array([0.5, -0.3])
    rate = 3.0 / 1.5
    system = np.block([[np.zeros((2, 2)), np.eye(2)], [rate * TURN, rate * (time * TURN - np.eye(2))]])
    exact = expm(4.0 * system) @ np.concatenate([x - centre, v])
    end = scene.run(begun(scene, [x], [v]), 2000)
    np.testing.assert_allclose(end.pos[0, 0], exact[:2] + centre, atol=3e-3)
    np.testing.assert_allclose(end.vel[0, 0], exact[2:], atol=3e-3)


@pytest.mark.slow
def test_outside_the_grid_it_asks_for_nothing() -> None:
    """The grid reaches from -5 to 15 and from -3.5 to 11.5; what counts is the predicted place."""
    scene = flown(whirl(time=0.5))
    assert not push(scene, (15.2, 4), (1, 1)).any()
    assert not push(scene, (14.8, 4), (1, 0)).any()
    assert push(scene, (15.2, 4), (-1, 0)).any()
    assert push(scene, (14.8, 11.4), (0, 0)).any()
    assert not push(scene, (14.8, 11.6), (0, 0)).any()


@pytest.mark.slow
def test_on_a_torus_the_nearest_grid_is_followed() -> None:
    flow = FollowFlow(
        weight=2, centre=(0.5, 0.0), spacing=4, counts=(2, 2), velocities=((1, 0.5), (1, 0), (1, 0), (1, 0)), time=0
    )
    scene = on_torus(flow)
    for place, inside in (((19, 11), True), ((1, 1), True), ((18.2, 1), False), ((3, 11), False), ((2.4, 10.1), True)):
        state = scene.start(0)
        state.pos[0, 0], state.vel[0, 0] = place, 0
        assert bool(scene.acceleration(state).any()) == inside
    state.pos[0, 0] = (18.6, 10.1)  # beside the lowest corner
    low = scene.acceleration(state)[0, 0]
    np.testing.assert_allclose(low, 2 * np.array([1, 0.5 * (1 - 0.1 / 4) ** 2]), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"counts": (9, 7, 2)}, r"counts = .*: the centre has 2 coordinates"),
        ({"counts": (9, 8)}, "velocities: 63, must be 72"),
        ({"velocities": ((0.0, 0.0),) * 62 + ((1.0, 1.0, 1.0),)}, r"velocities\[62\] = .*: must be 2 finite numbers"),
        ({"velocities": ((0.0, 0.0),) * 62 + ((1.0, math.inf),)}, "velocities"),
        ({"spacing": 0.0}, "spacing"),
    ],
)
def test_what_is_no_field_is_refused_in_one_line(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        FollowFlow(**{**whirl().model_dump(), **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("behaviour", [FollowPath, StayOnPath, FollowFlow])
def test_its_demo_is_a_small_scene_and_shows_its_way(behaviour: Any) -> None:
    scene = load_scene(behaviour.demo)
    assert 0 < scene.agents <= 20
    assert behaviour.demo_time == 8
    marks = scene.snapshot(scene.start(0)).marks
    assert {mark.kind for mark in marks} == (set() if behaviour is FollowFlow else {"way"})
    if behaviour is FollowPath:  # once for both ways
        assert len(marks) == math.ceil(polyline.pieces(scene.parts.effects[1].points, True)[1] / 0.3) + 1
