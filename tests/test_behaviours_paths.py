"""Path following, staying on a path, flow-field following: closed forms, and errors that other libraries have."""

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

ANYWHERE = Spawn(low=(0.0, 0.0), high=(1.0, 1.0))
RING_RADIUS = 10.0


def ring(pieces: int = 240, radius: float = RING_RADIUS) -> tuple[tuple[float, float], ...]:
    """Return a circle of many short pieces, counterclockwise."""
    angles = 2 * np.pi * np.arange(pieces) / pieces
    return tuple(zip((radius * np.cos(angles)).tolist(), (radius * np.sin(angles)).tolist(), strict=True))


def traffic(*follow: FollowPath, apart: float = 0.0, counts: tuple[int, ...] = (1,), **fields: Any) -> Scene:
    """Return a scene of two groups with a path each; the second may be idle, so that tests in 2-D share a kernel."""
    both = follow if len(follow) == 2 else (follow[0], follow[0].idle_copy())
    each = counts if len(counts) == 2 else (counts[0], 1)
    groups = tuple(
        Group(count=n, mass=1.0, radius=0.2, max_speed=2.0, max_force=fields.pop("max_force", 20.0), spawn=ANYWHERE)
        for n in each
    )
    steer = tuple(
        Steer(group=g, behaviours=(UnalignedAvoidance(weight=apart, horizon=1.5, margin=0.2), path))
        for g, path in enumerate(both)
    )
    return Scene(groups=groups, effects=steer, **({"dt": 0.02} | fields))


def begun(scene: Scene, places: Any, velocities: Any) -> State:
    """Return a state of these first agents; all others are far away and at rest."""
    state = scene.start(0)
    state.pos[0], state.vel[0] = -500.0, 0.0
    state.pos[0, :, 0] -= 50.0 * np.arange(scene.agents)
    state.pos[0, : len(places)], state.vel[0, : len(places)] = places, velocities
    return state


def push(scene: Scene, place: Any, velocity: Any) -> Array:
    """Return the acceleration of the first agent, m/s^2."""
    return np.asarray(scene.acceleration(begun(scene, [place], [velocity]))[0, 0])


STRAIGHT = FollowPath(weight=4, points=((0, 0), (20, 0)), radius=1, speed=2, time=0.5, keep=0)


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("dimension", [2, 3])
def test_lengths_and_nearest_points_of_a_path_match_those_of_10_000_points(closed: bool, dimension: int) -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 10, (7, dimension))
    path = polyline.pieces(points.tolist(), closed)
    corners = np.vstack([points, points[:1]]) if closed else points
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    assert path[1] == pytest.approx(lengths[-1])
    s = np.linspace(0, lengths[-1], 10_001)
    dense = np.stack([np.interp(s, lengths, corners[:, k]) for k in range(dimension)], axis=1)
    np.testing.assert_allclose(polyline.spine_points(path, s, dimension), dense, atol=1e-12)
    beyond = polyline.spine_points(path, [-1.0, lengths[-1] + 1], dimension)
    expected = polyline.spine_points(path, [lengths[-1] - 1, 1.0], dimension) if closed else corners[[0, -1]]
    np.testing.assert_allclose(beyond, expected, atol=1e-12)
    places = rng.uniform(-3, 13, (200, dimension))
    found, offset = polyline.project(path, places)
    gaps = np.linalg.norm(places[:, None] - dense, axis=2)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), gaps.min(axis=1), atol=3e-3)
    np.testing.assert_allclose(polyline.spine_points(path, found, dimension), places + offset, atol=1e-12)


def test_on_a_torus_pieces_of_a_path_and_offsets_are_the_shortest() -> None:
    path = polyline.pieces([(2, 5), (9, 5), (16, 5)], True, Torus(size=(20, 12)))
    assert path[1] == pytest.approx(20)
    found, offset = polyline.project(path, [(19, 6), (1, 11.5), (39.5, -7.5)])
    np.testing.assert_allclose(found, [17, 19, 17.5])
    np.testing.assert_allclose(offset, [(0, -1), (0, 5.5), (0, 0.5)], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"points": ((0.0, 0.0), (1.0, 0.0, 0.0))}, r"points\[1\] = .*: must have 2 numbers, as points\[0\] has"),
        ({"points": ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0))}, r"points\[2\] = .*: is where the point before it is"),
        ({"points": ((0.0, 0.0), (1.0, 0.0)), "closed": True}, "a closed path needs at least 3"),
        ({"points": ((0.0, 0.0), (1.0, 0.0), (0.0, 0.0)), "closed": True}, r"points\[0\] = .*: is where the point"),
        ({"way": 0}, "way"),
        ({"time": 0.0}, "time"),
    ],
)
def test_an_invalid_path_is_refused_in_one_line(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        FollowPath(**{**STRAIGHT.model_dump(), **change})
    assert "\n" not in str(caught.value)


def test_a_path_of_another_dimension_than_its_scene_is_refused() -> None:
    flat = Group(count=1, spawn=Spawn(low=(0, 0, 0), high=(1, 1, 1)))
    with pytest.raises(ValueError, match=r"effects\[0\]\.points\[0\] = .*, but dimension = 3"):
        Scene(dimension=3, groups=(flat,), effects=(STRAIGHT,))


# --- path following ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_force_is_zero_if_the_predicted_position_is_in_the_tube_and_ahead() -> None:
    """In the wrong direction along the path it is not zero."""
    there, back = traffic(STRAIGHT), traffic(STRAIGHT.model_copy(update={"way": -1}))
    for place, velocity in [((5, 0.5), (1, 0.5)), ((3, -0.9), (0.1, 0)), ((0.2, 0), (2, 0))]:
        assert not push(there, place, velocity).any()
        wrong_way = push(back, place, velocity)
        assert wrong_way[0] < 0
        np.testing.assert_allclose(push(back, place, -np.array(velocity)) == 0, True)


def test_an_agent_that_would_leave_the_tube_seeks_the_spine_ahead() -> None:
    """The closed form: S = V unit(spine(s + T |v|) - x) - v."""
    x, v = np.array([4.0, 0.8]), np.array([1.0, 1.0])
    target = np.array([4 + 0.5 * math.sqrt(2), 0.0])
    steering = 2 * (target - x) / np.linalg.norm(target - x) - v
    np.testing.assert_allclose(push(traffic(STRAIGHT), x, v), 4 * steering, rtol=1e-12)


def test_an_agent_at_rest_is_pushed_along_the_path() -> None:
    """At rest the look-ahead T |v| is 0: without a push, an agent on the spine would stand for ever."""
    for place in ((5.0, 0.0), (5.0, 0.4), (0.0, 0.0)):
        assert push(traffic(STRAIGHT), place, (0, 0))[0] > 1.0
    assert push(traffic(STRAIGHT.model_copy(update={"way": -1})), (5.0, 0.0), (0, 0))[0] < -1.0


def test_a_slow_agent_speeds_up_if_keep_is_positive() -> None:
    """By Reynolds' rule (keep = 0) an agent that has just begun to move coasts for ever, at 1 % of its speed."""
    for keep, fast in ((0.0, 0.5), (0.8, 1.5)):
        scene = traffic(STRAIGHT.model_copy(update={"keep": keep}))
        end = scene.run(begun(scene, [(1, 0)], [(0, 0)]), 300)
        assert (end.vel[0, 0, 0] > fast) == (keep > 0)


def test_on_a_circular_path_the_orbit_has_the_radius_of_the_closed_form() -> None:
    """In a tube of no width, an agent always seeks the point L = T |v| ahead on the ring.

    The orbit r solves m v^2 / r = w V sin a and v = V cos a, with a the angle of that point below the tangent.
    """
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
    assert abs(orbit - RING_RADIUS) > 0.001  # the orbit is not the ring itself
    assert np.linalg.norm(end.pos[0, 0]) - RING_RADIUS == pytest.approx(orbit - RING_RADIUS, abs=2e-3)


def test_on_a_circular_path_an_agent_stays_in_the_tube_for_two_laps() -> None:
    path = FollowPath(weight=20, points=ring(), closed=True, radius=0.6, speed=2, time=0.4, keep=0.8)
    scene = traffic(path)
    state = begun(scene, [(RING_RADIUS, -1.0)], [(0, 2)])
    out, angles = [], []
    for _ in range(480):
        state = scene.step(state, steps=10)
        out.append(abs(np.linalg.norm(state.pos[0, 0]) - RING_RADIUS))
        angles.append(math.atan2(state.pos[0, 0, 1], state.pos[0, 0, 0]))
    assert max(out) < 0.6
    assert max(out) > 0.3  # it leaves the spine: within the tube there is no force
    turned = np.unwrap(angles)
    assert (np.diff(turned) > 0).all()
    assert turned[-1] - turned[0] > 2 * 2 * np.pi
    assert not push(scene, (RING_RADIUS, -0.3), (0, 2)).any()  # no force across the seam


def test_traffic_in_both_directions_passes_without_contact() -> None:
    """Eight agents move against eight others in a tube of 2 m; all keep going round."""
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
    assert gone.min() > 0.9 * 2.0 * 40.0 - 2.0  # 2 m less, for they began at rest
    assert gap > 0.4  # both radii
    assert out < 1.2  # the tube, and a little more to give way at its edge


def test_agents_stop_at_the_end_of_an_open_path() -> None:
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


def test_path_following_does_not_depend_on_dt() -> None:
    """Positions for dt and dt / 4 differ by the error of the method, 2 cm after 24 m."""
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
def test_a_path_may_wrap_around_a_torus() -> None:
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
    groups = (Group(count=count, max_speed=2, max_force=20, spawn=ANYWHERE),)
    return Scene(space=space or Plane(), groups=groups, effects=(path,), dt=0.02, **fields)


@pytest.mark.slow
def test_stay_on_path_keeps_agents_in_the_tube_in_both_directions() -> None:
    """Twenty agents begin on the spine in all directions; the force is zero if the predicted position is inside."""
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
    assert (np.sign(state.pos[0, :, 0]) == ways).all()  # no agent turns round
    assert not push(scene, (5, 3.9), (-2, 0.1)).any()
    v = np.array([1.0, 1.0])
    steering = 2 * np.array([0.5, -0.9]) / math.hypot(0.5, 0.9) - v
    np.testing.assert_allclose(push(scene, (5, 3.9), v), 6 * steering, rtol=1e-12)


# --- flow-field following ---------------------------------------------------------------------------------------------

TURN = np.array([[-0.12, -0.24], [0.24, -0.12]])
"""Velocity gradient of a whirl, 1/s; a grid represents this linear field exactly."""


def whirl(time: float = 0.0, **fields: Any) -> FollowFlow:
    counts, spacing, centre = (9, 7), 2.5, np.array([5.0, 4.0])
    at = np.stack(np.meshgrid(*(spacing * (np.arange(n) - (n - 1) / 2) for n in counts), indexing="ij"), axis=-1)
    velocities = tuple(map(tuple, (at @ TURN.T).reshape(-1, 2).tolist()))
    given = {"weight": 3.0, "centre": tuple(centre.tolist()), "spacing": spacing, "counts": counts} | fields
    return FollowFlow(velocities=velocities, time=time, **given)


def flown(flow: FollowFlow, **fields: Any) -> Scene:
    groups = (Group(count=1, mass=1.5, spawn=ANYWHERE),)
    return Scene(groups=groups, effects=(flow,), **({"dt": 0.002} | fields))


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.0, 0.5])
def test_motion_in_a_linear_field_matches_the_exact_solution(time: float) -> None:
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
def test_follow_flow_is_zero_outside_its_grid() -> None:
    """The grid reaches from -5 to 15 and from -3.5 to 11.5; the predicted position counts."""
    scene = flown(whirl(time=0.5))
    assert not push(scene, (15.2, 4), (1, 1)).any()
    assert not push(scene, (14.8, 4), (1, 0)).any()
    assert push(scene, (15.2, 4), (-1, 0)).any()
    assert push(scene, (14.8, 11.4), (0, 0)).any()
    assert not push(scene, (14.8, 11.6), (0, 0)).any()


@pytest.mark.slow
def test_on_a_torus_the_nearest_image_of_the_grid_counts() -> None:
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
        ({"counts": (9, 7, 2)}, r"counts = .*: must have 2 numbers, as centre has"),
        ({"counts": (9, 8)}, "velocities: 63, must be 72"),
        ({"velocities": ((0.0, 0.0),) * 62 + ((1.0, 1.0, 1.0),)}, r"velocities\[62\] = .*: must be 2 finite numbers"),
        ({"velocities": ((0.0, 0.0),) * 62 + ((1.0, math.inf),)}, "velocities"),
        ({"spacing": 0.0}, "spacing"),
    ],
)
def test_an_invalid_field_is_refused_in_one_line(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        FollowFlow(**{**whirl().model_dump(), **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("behaviour", [FollowPath, StayOnPath, FollowFlow])
def test_the_demo_of_a_path_behaviour_is_small_and_marks_its_path(behaviour: Any) -> None:
    scene = load_scene(behaviour.demo)
    assert 0 < scene.agents <= 20
    assert behaviour.demo_time == 8
    marks = scene.snapshot(scene.start(0)).marks
    assert {mark.kind for mark in marks} == (set() if behaviour is FollowFlow else {"way"})
    if behaviour is FollowPath:  # one path for both directions
        assert len(marks) == math.ceil(polyline.pieces(scene.parts.effects[1].points, True)[1] / 0.3) + 1
