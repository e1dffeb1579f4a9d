"""Behaviours towards places and towards other agents, each alone in a small scene: closed forms and purposes.

All scenes use the catalogue's families, so that no test compiles a kernel of its own. The other agents have
max_force = 0: they are also steered, but go straight on.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockenv import steering
from flockenv.behaviours import (
    Arrive,
    Dock,
    Evade,
    Face,
    Flee,
    FollowLeader,
    Formation,
    Hide,
    Interpose,
    MatchVelocity,
    OffsetPursue,
    Pursue,
    Seek,
    Shadow,
    TargetSpeed,
    Wander,
)
from flockenv.behaviours.steer import Steer
from flockenv.core.warnings import LookaheadWarning
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Effect
from flockenv.scene import Group, Scene
from flockenv.steering.vectorize import rows
from tests.catalogue import EFFECTS, Array, in_dimension, scene_of

ANYWHERE = Spawn(low=(0, 0), high=(1, 1))
RADIUS = 40.0
"""m, range of sight of all behaviours here."""


def family(effect: Effect) -> tuple[Effect, ...]:
    """Return the effect among the others of its family, which are idle, with the same radius and the same groups."""
    name = next(row.family for row in EFFECTS if row.effect.kind == effect.kind)
    if not name:
        return (effect,)
    found = []
    for row in EFFECTS:
        if row.family == name:
            other = in_dimension(row.effect, 2).idle_copy()
            fields = type(other).model_fields
            change: dict[str, Any] = {"radius": RADIUS} if name == "others" else {}
            change |= {"group": 1} if getattr(other, "group", None) is not None else {}
            change |= {"other": 2} if "other" in fields else {}
            found.append(effect if other.kind == effect.kind else other.model_copy(update=change))
    return tuple(found)


def trio(effect: Effect, followers: int = 1, dt: float = 0.01, **body: Any) -> Scene:
    """Return a scene of `followers` that the effect steers, and two groups of one that go straight on."""
    body = {"max_speed": 2.0} | body
    straight = Group(count=1, max_force=0, spawn=ANYWHERE)
    return scene_of(*family(effect), groups=(Group(count=followers, spawn=ANYWHERE, **body), straight, straight), dt=dt)


def at(scene: Scene, *bodies: tuple[Any, Any]) -> State:
    """Return a state with (place, velocity) of the first agents; the rest are at (30, 30), at rest."""
    state = scene.start(0)
    state.pos[...], state.vel[...] = 30.0, 0.0
    for k, (place, velocity) in enumerate(bodies):
        state.pos[0, k], state.vel[0, k] = place, velocity
    return state


def course(scene: Scene, state: State, seconds: float, every: int = 1) -> tuple[Array, Array]:
    """Return positions and velocities of a run, (T, N, 2), after each `every` steps."""
    pos, vel = [], []
    for _ in range(round(seconds / scene.dt / every)):
        state = scene.step(state, steps=every)
        pos.append(state.pos[0].copy())
        vel.append(state.vel[0].copy())
    return np.array(pos), np.array(vel)


def change(scene: Scene, state: State) -> Array:
    """Return the force on each agent of 1 kg at this instant, (N, 2) N."""
    return np.asarray((scene.step(state).vel - state.vel)[0] / scene.dt)


def crowd(count: int, near: float, far: float, seed: int = 5) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 2))
    return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True) * rng.uniform(near, far, (count, 1)))


def unit(a: Array) -> Array:
    return np.asarray(a / np.linalg.norm(a, axis=-1, keepdims=True))


# --- a place ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "sign"), [(Seek, 1), (Flee, -1)])
def test_seek_and_flee_speed_up_exponentially_like_a_driving_force(kind: type[Effect], sign: int) -> None:
    """From rest v = V (1 - exp(-k t)) along the line, k = weight / m; with steps, (1 - k dt)^n replaces exp."""
    scene = trio(kind(weight=4, target=(0, 0)), followers=20, mass=2.0, max_speed=1.5)
    start = scene.start(0)
    start.pos[0, :20], start.vel[...] = crowd(20, 5, 9), 0
    end = scene.run(start, 100)
    gone = 1 - (1 - 2 * scene.dt) ** 100
    assert gone == pytest.approx(1 - math.exp(-2), rel=0.01)
    np.testing.assert_allclose(end.vel[0, :20], -sign * 1.5 * gone * unit(start.pos[0, :20]), rtol=1e-9)
    d = np.linalg.norm(course(scene, start, 2)[0][:, :20], axis=2)
    assert (sign * np.diff(d, axis=0) < 0).all()  # the pseudo-code of 1999 has the opposite sign


def test_flee_is_zero_beyond_its_panic_radius() -> None:
    scene = trio(Flee(weight=4, target=(0, 0), radius=3), followers=3)
    force = change(scene, at(scene, ((3.01, 0), (-1, 0)), ((2.99, 0), (-1, 0)), ((0, 0), (0, 1))))
    np.testing.assert_allclose(force[:3], [(0, 0), (4 * 3, 0), (0, 4 * 1)], atol=1e-9)


def test_arrive_stops_within_a_centimetre_and_does_not_overshoot() -> None:
    """The ramp is the shortest on which max_force suffices to stop: d_slow = V^2 m / F_max, here 1 m."""
    scene = trio(Arrive(weight=50, target=(0, 0), slow_radius=1), followers=40, max_force=4.0)
    start = scene.start(0)
    start.pos[0, :40], start.vel[...] = crowd(40, 3, 9), 0
    pos, vel = (a[:, :40] for a in course(scene, start, 10))
    beyond = -(pos * unit(start.pos[0, :40])).sum(axis=2)
    assert beyond.max() < 1e-3
    assert np.linalg.norm(pos[-1], axis=1).max() < 0.01
    assert np.linalg.norm(vel[-1], axis=1).max() < 0.01


def test_arrive_warns_of_a_ramp_that_is_too_short_and_agents_overshoot() -> None:
    """Several libraries have this error: a look-ahead shorter than the stopping distance."""
    arrive = Arrive(weight=50, target=(0, 0), slow_radius=0.2)
    with pytest.warns(LookaheadWarning, match=r"slow_radius = 0.2 m: overshoots.* = 1 m") as warned:
        scene = trio(arrive, max_force=4.0)
    assert len(warned) == 1
    pos, _ = course(scene, at(scene, ((6, 0), (0, 0))), 8)
    assert pos[:, 0, 0].min() < -0.1
    trio(arrive.model_copy(update={"speed": 0.5}), max_force=4.0)  # a slow agent can stop
    trio(arrive)  # and one without a bound of force


def test_dock_ends_at_the_place_slowly_and_in_the_right_direction() -> None:
    """Agents start on all sides, also behind; they pass the gate."""
    way = np.array([0.6, 0.8])
    dock = Dock(weight=50, target=(0, 0), direction=(3, 4), gate=3, width=0.3, slow_radius=1.5)
    scene = trio(dock, followers=40, dt=0.02)
    start = scene.start(0)
    start.pos[0, :40], start.vel[...] = crowd(40, 1, 9), 0
    start.pos[0, :4] = way * np.array([[-5], [-1.5], [1.5], [5]])  # on the axis, on either side
    pos, vel = (a[:, :40] for a in course(scene, start, 25))
    assert np.linalg.norm(pos[-1], axis=1).max() < 1e-3
    assert np.linalg.norm(vel[-1], axis=1).max() < 2e-3
    for k in range(40):
        d = np.linalg.norm(pos[:, k], axis=1)
        last = int(np.nonzero(d > 0.05)[0][-1])  # the last 5 cm
        assert (unit(vel[last, k]) * way).sum() > math.cos(math.radians(2))
        inside = pos[int(np.nonzero(d > 1.0)[0][-1]), k]  # 1 m away it is on the axis, in front of the place
        assert inside @ way < -0.9
        assert abs(inside[0] * way[1] - inside[1] * way[0]) < 0.1


# --- a direction, a speed ---------------------------------------------------------------------------------------------


def test_face_turns_by_its_closed_form_and_keeps_the_speed() -> None:
    """tan(a/2) = tan(a0/2) exp(-k t) below 90 degrees; above, the heading turns at the rate k."""
    scene = trio(Face(weight=2, heading=(0, 3)), followers=4, dt=0.0005)
    angles = np.radians([80.0, -60.0, 20.0, 130.0])
    start = at(scene, *(((0, 0), 1.5 * np.array([math.sin(a), math.cos(a)])) for a in angles))
    end = scene.run(start, 2000).vel[0, :4]
    found = np.arctan2(end[:, 0], end[:, 1])
    first = math.radians(40) / 2  # s, from 130 to 90 degrees at 2 rad/s
    seconds, begin = np.array([1, 1, 1, 1 - first]), np.radians([80, -60, 20, 90])
    np.testing.assert_allclose(found, 2 * np.arctan(np.tan(begin / 2) * np.exp(-2 * seconds)), rtol=3e-3)
    np.testing.assert_allclose(np.linalg.norm(end, axis=1), 1.5, rtol=2e-3)


def test_face_acts_across_the_velocity_and_turns_right_if_the_heading_is_opposite() -> None:
    face = rows(steering.face)
    v = np.array([[2.0, 0.0], [-1.0, 0.5], [0.0, 0.0], [-2.0, 0.0]])
    np.testing.assert_allclose((face(v, [1.0, 0.0]) * v).sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(face(v, [1.0, 0.0])[[0, 2, 3]], [(0, 0), (0, 0), (0, 2)], atol=1e-12)


def test_target_speed_is_approached_exponentially_without_turning() -> None:
    scene = trio(TargetSpeed(weight=2, speed=1), followers=3)
    end = scene.run(at(scene, ((0, 0), (1.2, 1.6)), ((0, 0), (0, -0.5)), ((0, 0), (0, 0))), 100).vel[0]
    left = (1 - 2 * scene.dt) ** 100
    expected = [np.array([0.6, 0.8]) * (1 + left), np.array([0, -1]) * (1 - 0.5 * left), (0, 0)]
    np.testing.assert_allclose(end[:3], expected, atol=1e-9)


# --- wander -----------------------------------------------------------------------------------------------------------


def wanderers(dt: float, seconds: float = 6.0, seed: int = 3) -> tuple[Array, Array]:
    scene = trio(Wander(weight=3, strength=1, period=0.8), followers=30, dt=dt, max_speed=1.0)
    start = scene.start(seed)
    start.pos[...] = 0
    start.vel[0, :30] = crowd(30, 1, 1)
    pos, vel = course(scene, start, seconds, every=round(0.1 / dt))
    return pos[:, :30], vel[:, :30]


def test_wander_follows_the_same_path_for_every_dt() -> None:
    """Paths differ only by the error of the method, which is proportional to dt."""
    coarse, middle, fine, finest = (wanderers(dt)[0] for dt in (0.02, 0.01, 0.005, 0.00125))
    errors = [np.linalg.norm(a[-1] - finest[-1], axis=1) for a in (coarse, middle, fine)]
    assert errors[0].max() < 0.3  # of 6 m; noise per step would give metres
    assert 1.5 < np.median(errors[0] / errors[1]) < 2.8
    assert 1.5 < np.median(errors[1] / errors[2]) < 2.8


def test_wander_turns_slowly_and_persistently_and_differs_between_agents() -> None:
    pos, vel = wanderers(0.01, 20.0)
    speed = np.linalg.norm(vel[20:], axis=2)
    assert 0.65 < speed.min() <= speed.max() <= 1 + 1e-9
    way = unit(vel)
    assert (way[1:] * way[:-1]).sum(axis=2).min() > math.cos(math.radians(20))  # in 0.1 s
    assert abs((way[60:] * way[:-60]).sum(axis=2).mean()) < 0.25  # the direction is lost after 6 s
    turn = way[1:, :, 0] * way[:-1, :, 1] - way[1:, :, 1] * way[:-1, :, 0]
    assert np.mean(turn[1:] * turn[:-1] > 0) > 0.8  # white noise: 0.5
    assert abs(np.corrcoef(turn.T)[~np.eye(30, dtype=bool)]).mean() < 0.2
    other = wanderers(0.01, 2.0, seed=4)[0]
    assert np.linalg.norm(other[-1] - pos[19], axis=1).mean() > 0.2  # another world, another path


def test_wander_starts_from_rest_in_all_directions() -> None:
    scene = trio(Wander(weight=3), followers=200, max_speed=1.0)
    start = scene.start(1)
    start.vel[...] = 0
    way = unit(scene.step(start).vel[0, :200])
    assert np.linalg.norm(way.mean(axis=0)) < 0.2


# --- pursue, evade ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [(6, 2), (-5, 4), (0, -6)])
def test_pursue_reaches_the_exact_intercept_point(place: tuple[float, float]) -> None:
    """At full speed from the first step: at the time of the quadratic equation, in a straight line."""
    quarry = np.array([0.7, 1.1])
    scene = trio(Pursue(weight=100, group=1, radius=RADIUS, longest=30))
    time = float(rows(steering.interception_time)(place, quarry, 2.0))
    pos, _ = course(scene, at(scene, ((0, 0), (0, 0)), (place, quarry)), time)
    np.testing.assert_allclose(pos[-1, 0], np.array(place) + quarry * time, atol=0.05)
    way = unit(np.array(place) + quarry * time)
    assert abs(pos[:, 0] @ np.array([way[1], -way[0]])).max() < 0.02


@pytest.mark.parametrize("predictor", ["distance", "opensteer", "exact"])
def test_every_predictor_catches_a_slower_quarry_and_exact_is_the_fastest(predictor: str) -> None:
    caught = {}
    for which in (predictor, "exact"):
        scene = trio(Pursue(weight=100, group=1, radius=RADIUS, predictor=which, longest=30))
        pos, _ = course(scene, at(scene, ((0, 0), (0, 0)), ((8, 0), (0, 1.2))), 9)
        gap = np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1)
        caught[which] = scene.dt * int(np.nonzero(gap < 0.1)[0][0])
    assert caught["exact"] <= caught[predictor] + 1e-9
    assert caught["exact"] == pytest.approx(8 / math.sqrt(4 - 1.44), abs=0.1)


def test_pursue_and_evade_use_the_time_of_their_predictor() -> None:
    """F = w (V unit(+-(p + u T)) - v), with T of each predictor written out here."""
    p, u, v, top = np.array([3.0, 4.0]), np.array([-0.5, 0.8]), np.array([1.0, 0.0]), 2.0
    theirs = math.hypot(*u)
    times = {  # cosines 0.6 and -0.53: beyond 45 degrees, so aside and across
        (Pursue, "distance"): 0.5 * 5 / top, (Pursue, "opensteer"): 0.8 * 5 / 1.0,
        (Pursue, "exact"): float(rows(steering.interception_time)(p, u, top)),
        (Evade, "distance"): 0.5 * 5 / top, (Evade, "opensteer"): 5 / theirs,
        (Evade, "exact"): float(rows(steering.interception_time)(-p, v, theirs)),
    }  # fmt: skip
    for (kind, predictor), time in times.items():
        fields = {"fov": 300} if kind is Evade else {}
        scene = trio(kind(weight=3, group=1, radius=RADIUS, predictor=predictor, factor=0.5, longest=60, **fields))
        force = change(scene, at(scene, ((0, 0), v), (p, u)))[0]
        sign = 1 if kind is Pursue else -1
        np.testing.assert_allclose(force, 3 * (sign * top * unit(p + u * time) - v), atol=1e-9)
        short = scene.with_effects(*family(kind(
            weight=3, group=1, radius=RADIUS, predictor=predictor, factor=0.5, longest=0, **fields)))  # fmt: skip
        np.testing.assert_allclose(
            change(short, at(short, ((0, 0), v), (p, u)))[0], 3 * (sign * top * unit(p) - v), atol=1e-9
        )


def test_the_prediction_time_follows_the_table_of_opensteer() -> None:
    """k by place (ahead, aside, behind) and heading (parallel, across, against), T = k d / |v|, at most `longest`."""
    places, ways = [(1, 0), (0, 1), (-1, 0)], [(1, 0), (0, 1), (-1, 0)]
    expected = [[4, 1.8, 0.85], [1, 0.8, 4], [0.5, 2, 2]]
    time = rows(steering.opensteer_time)
    found = [[float(time(np.array(p) * 6.0, [3.0, 0.0], np.array(w) * 0.5, 99.0)) for w in ways] for p in places]
    np.testing.assert_allclose(found, np.array(expected) * 2)
    assert time([6.0, 0.0], [0.0, 0.0], [1.0, 0.0], 7.0) == 7.0
    assert time([6.0, 0.0], [0.5, 0.0], [1.0, 0.0], 7.0) == 7.0
    assert rows(steering.approach_time)([6.0, 0.0], 0.0, 7.0) == 7.0
    assert rows(steering.approach_time)([6.0, 0.0], 2.0, 7.0) == 3.0


def test_evade_escapes_from_a_pursuer_that_is_not_faster() -> None:
    scene = trio(Evade(weight=20, group=1, radius=RADIUS, fov=300), followers=20)
    start = at(scene, *(((x, y), (0, 0)) for x, y in crowd(20, 2, 4)))
    start.pos[0, 20], start.vel[0, 20] = (0, 0), (1.9, 0)
    pos, _ = course(scene, start, 5)
    gap = np.linalg.norm(pos[:, :20] - pos[:, 20:21], axis=2)
    assert gap.min() > 0.9
    assert (gap[-1] > np.linalg.norm(start.pos[0, :20], axis=1)).all()


@pytest.mark.parametrize("quarry", [(0.0, 0.0), (0.3, 0.4)])
def test_offset_pursuit_passes_its_quarry_at_the_distance(quarry: tuple[float, float]) -> None:
    pursuit = OffsetPursue(weight=30, radius=RADIUS, distance=1.5)
    for y in (-2.0, 0.0, 0.7, 2.0):  # also if the quarry is exactly ahead
        scene = trio(pursuit)
        pos, _ = course(scene, at(scene, ((0, y), (2, 0)), ((10, 0), quarry)), 12)
        gap = np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1)
        first = int(np.argmax(np.diff(gap) > 0))  # the nearest point, before the agent turns round
        assert gap[first] == pytest.approx(1.5, rel=0.05)


def test_shadow_approaches_and_then_matches_the_velocity_of_its_quarry() -> None:
    scene = trio(Shadow(weight=20, group=1, radius=RADIUS, distance=1.5, band=0.5), followers=10)
    start = at(scene, *(((x, y), (0, 0)) for x, y in crowd(10, 4, 8)))
    start.pos[0, 10], start.vel[0, 10] = (0, 0), (0.8, 0.6)
    pos, vel = course(scene, start, 25)
    gap = np.linalg.norm(pos[-1, :10] - pos[-1, 10], axis=1)
    assert gap.min() > 1.5 - 0.1
    assert gap.max() < 1.5 + 0.1
    np.testing.assert_allclose(vel[-1, :10], np.tile([0.8, 0.6], (10, 1)), atol=0.02)
    force = change(scene, at(scene, ((0, 0), (0.1, 0.2)), *(((40, 40), (0, 0)),) * 9, ((1.4, 0), (0.8, 0.6))))[0]
    np.testing.assert_allclose(force, 20 * np.array([0.7, 0.4]), atol=1e-9)  # inside, it only matches velocity


def test_matched_velocities_approach_each_other_exponentially() -> None:
    scene = trio(MatchVelocity(weight=2, radius=RADIUS))
    end = scene.run(at(scene, ((0, 0), (-1, 0)), ((3, 0), (0.4, 0.6))), 100)
    left = (1 - 2 * scene.dt) ** 100
    np.testing.assert_allclose(end.vel[0, 0], np.array([0.4, 0.6]) + np.array([-1.4, -0.6]) * left, rtol=1e-9)


# --- formations -------------------------------------------------------------------------------------------------------


def test_a_formation_keeps_its_place_without_lagging_behind() -> None:
    """Arriving at the predicted place, as yuka does, would lag by a large part of slow_radius."""
    velocity = np.array([0.6, 0.8])
    formation = Formation(weight=20, group=1, radius=RADIUS, ahead=-2, left=1.5, slow_radius=1)
    scene = trio(formation, followers=10)
    start = at(scene, *(((x, y), (0, 0)) for x, y in crowd(10, 3, 8)))
    start.pos[0, 10], start.vel[0, 10] = (0, 0), velocity
    pos, vel = course(scene, start, 20)
    place = pos[-1, 10] + -2 * velocity + 1.5 * np.array([-0.8, 0.6])
    np.testing.assert_allclose(pos[-1, :10], np.tile(place, (10, 1)), atol=1e-3)
    np.testing.assert_allclose(vel[-1, :10], np.tile(velocity, (10, 1)), atol=1e-3)


def test_followers_end_up_behind_their_leader() -> None:
    follow = FollowLeader(weight=20, group=1, radius=RADIUS, distance=1, headway=0.5, aside=0, slow_radius=1)
    scene = trio(follow, followers=5)
    start = at(scene, *(((x, y), (0, 0)) for x, y in crowd(5, 3, 8)))
    start.pos[0, 5], start.vel[0, 5] = (0, 0), (1.2, 0)
    pos, _ = course(scene, start, 15)
    np.testing.assert_allclose(pos[-1, :5], np.tile(pos[-1, 5] - [1 + 0.5 * 1.2, 0], (5, 1)), atol=1e-3)


@pytest.mark.parametrize("y", [-0.7, -0.2, 0.0, 0.3])
def test_a_follower_in_front_of_the_leader_moves_aside(y: float) -> None:
    """It leaves the box before the leader arrives, and stays clear of it; exactly ahead, it moves to the right."""
    follow = FollowLeader(weight=20, group=1, radius=RADIUS, distance=1, ahead=3, aside=0.8, slow_radius=1)
    scene = trio(follow, max_force=10.0)
    pos, vel = course(scene, at(scene, ((2.5, y), (0, 0)), ((0, 0), (1, 0))), 15)
    rel = pos[:, 0] - pos[:, 1]
    out = int(np.nonzero(abs(rel[:, 1]) >= 0.8)[0][0])
    assert rel[out, 0] > 0.5
    assert np.linalg.norm(rel, axis=1).min() > 0.5
    assert np.sign(rel[out, 1]) == (np.sign(y) or -1)
    assert abs(vel[: out - 1, 0, 0]).max() < 1e-9  # only sideways
    np.testing.assert_allclose(rel[-1], (-1, 0), atol=0.02)


def test_interpose_ends_at_its_share_of_the_line_between_two_agents() -> None:
    for share, place in ((0.5, (1.0, 2.0)), (0.25, (0.0, 1.5))):
        scene = trio(Interpose(weight=20, group=1, other=2, radius=RADIUS, share=share, slow_radius=1))
        pos, _ = course(scene, at(scene, ((-4, -5), (0, 0)), ((-1, 1), (0, 0)), ((3, 3), (0, 0))), 12)
        np.testing.assert_allclose(pos[-1, 0], place, atol=0.01)


def test_interpose_stays_on_the_line_between_two_moving_agents() -> None:
    """It heads for the middle predicted for d / V, so it lags by d = u slow / (V + u) behind a middle at speed u."""
    scene = trio(Interpose(weight=20, group=1, other=2, radius=RADIUS, slow_radius=1))
    pos, _ = course(scene, at(scene, ((-4, -5), (0, 0)), ((0, 1), (1, 0)), ((0, -3), (1, 0))), 15)
    lag = (pos[-1, 1] + pos[-1, 2]) / 2 - pos[-1, 0]
    np.testing.assert_allclose(lag, (1 / (2 + 1), 0), atol=0.01)


def test_interpose_takes_the_two_nearest_of_one_group_and_is_zero_for_one_alone() -> None:
    interpose = Interpose(weight=1, group=1, other=1, radius=RADIUS, slow_radius=1)
    straight = Group(count=3, max_force=0, spawn=ANYWHERE)
    groups = (Group(count=1, max_speed=2, spawn=ANYWHERE), straight, Group(count=1, max_force=0, spawn=ANYWHERE))
    scene = scene_of(*family(interpose), groups=groups, dt=0.01)
    places = [(1.0, 0.0), (0.0, 2.0), (9.0, 9.0)]
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1)):  # for any order of the agents
        state = at(scene, ((0, 0), (0, 0)), *((places[k], (0, 0)) for k in order), ((0.1, 0), (0, 0)))
        np.testing.assert_allclose(change(scene, state)[0], 2 * unit(np.array([0.5, 1.0])), atol=1e-9)
    state = at(scene, ((0, 0), (0.3, 0)), ((1, 0), (0, 0)), *(((99, 0), (0, 0)),) * 2)
    np.testing.assert_array_equal(change(scene, state)[0], 0)


# --- hide -------------------------------------------------------------------------------------------------------------

ROCKS = (((-2.0, -1.0), 1.0), ((2.5, 0.5), 0.6))


def hiding(count: int, rocks: Any = ROCKS, **fields: Any) -> Scene:
    hide = Hide(**({"weight": 20.0, "group": 1, "radius": RADIUS, "slow_radius": 1.0, "margin": 0.3} | fields))
    straight = Group(count=1, max_force=0, spawn=ANYWHERE)
    obstacles = tuple({"centre": centre, "radius": radius} for centre, radius in rocks)
    groups = (Group(count=count, max_speed=2, radius=0.2, spawn=ANYWHERE), straight)
    return scene_of(hide, groups=groups, obstacles=obstacles, dt=0.01)


def visible(eye: Array, place: Array, radius: float) -> float:
    """Return the share of the width of a disc that is visible between the rocks, by rays."""
    d = place - eye
    across = np.array([-d[1], d[0]]) / np.linalg.norm(d)
    seen = 0
    for s in np.linspace(-radius, radius, 41):
        ray = d + s * across
        for centre, rock in ROCKS:
            t = np.clip((np.array(centre) - eye) @ ray / (ray @ ray), 0, 1)
            if np.linalg.norm(eye + t * ray - centre) < rock:
                break
        else:
            seen += 1
    return seen / 41


@pytest.mark.parametrize("eye", [(-7.0, 1.0), (0.0, 6.0), (8.0, -1.0)])
def test_hide_breaks_the_line_of_sight(eye: tuple[float, float]) -> None:
    scene = hiding(12)
    start = at(scene, *(((x, y), (0, 0)) for x, y in crowd(12, 3, 5)))
    start.pos[0, 12] = eye
    end = scene.run(start, 1200)
    places = np.array([
        np.array(c) + (r + 0.2 + 0.3) * unit(np.array(c) - np.array(eye)) for c, r in ROCKS
    ])  # fmt: skip
    for k in range(12):
        nearest = int(np.argmin(np.linalg.norm(places - start.pos[0, k], axis=1)))
        np.testing.assert_allclose(end.pos[0, k], places[nearest], atol=0.02)
        assert visible(np.array(eye), end.pos[0, k], 0.2) == 0
    assert max(visible(np.array(eye), start.pos[0, k], 0.2) for k in range(12)) == 1  # not hidden at first


def test_hide_evades_without_a_hiding_place_and_is_zero_without_a_seeker_in_sight() -> None:
    scene = hiding(2, rocks=())
    state = at(scene, ((0, 0), (0, 0)), ((3, 0), (0, 1)), ((1, 1), (0, -2)))
    soon = np.array([(1, 1), (-2, 1)]) + np.array([0, -2]) * 0.5  # predicted for half a second
    np.testing.assert_allclose(change(scene, state)[:2], 20 * (-2 * unit(soon) - state.vel[0, :2]), atol=1e-9)
    for rocks in ((), ROCKS):
        scene = hiding(2, rocks=rocks, radius=1.0)
        np.testing.assert_array_equal(change(scene, state)[1], 0)


@pytest.mark.slow  # two kernels
def test_with_a_range_only_obstacles_whose_surface_is_within_it_hide() -> None:
    """The rocks' surfaces are 1.24 and 1.95 m from the agent; without one in range it flees as if there were none."""

    def force(rocks: Any, **fields: Any) -> Array:
        scene = hiding(1, rocks=rocks, **fields)
        return np.asarray(change(scene, at(scene, ((0, 0), (0, 0)), ((1, 5), (0, 0))))[0])

    np.testing.assert_array_equal(force(ROCKS, range=5.0), force(ROCKS))
    np.testing.assert_array_equal(force(ROCKS, range=1.5), force(ROCKS[:1], range=1.5))
    np.testing.assert_array_equal(force(ROCKS, range=1.2), force((), range=1.2))
    assert np.abs(force(ROCKS, range=1.2) - force(ROCKS, range=1.5)).max() > 1


# --- what all behaviours must obey ------------------------------------------------------------------------------------

ABOUT_OTHERS = tuple(row for row in EFFECTS if row.family == "others")


@pytest.mark.parametrize("row", ABOUT_OTHERS, ids=lambda row: row.name)
def test_an_agent_alone_gets_no_force(row: Any) -> None:
    """The test fails if a mean includes the agent itself, or if a count is wrong."""
    scene = scene_of(*row.company(2), groups=(Group(count=1, max_speed=2, spawn=ANYWHERE),))
    state = scene.start(0)
    state.vel[...] = (0.3, -0.4)
    np.testing.assert_array_equal(scene.run(state, 5).vel, state.vel)


@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("row", ABOUT_OTHERS, ids=lambda row: row.name)
def test_motion_is_finite_for_agents_in_one_place_or_on_one_line(row: Any, speed: float) -> None:
    """At rest or in motion; no agent exceeds max_speed."""
    scene = scene_of(*row.company(2), groups=(Group(count=6, max_speed=2, spawn=ANYWHERE),), dt=0.01)
    for places in ([0, 0, 0, 0, 0, 0], [0, 1, 2, 3, 4, 5], [0, 0, 1e-12, 1, 1, 1 + 1e-12]):
        state = scene.start(0)
        state.pos[0, :, 0], state.pos[0, :, 1] = places, 0
        state.vel[0, :, 0], state.vel[0, :, 1] = speed * np.array([1, -1, 1, -1, -1, 1]), 0
        end = scene.run(state, 100)
        assert np.isfinite(end.pos).all()
        assert np.linalg.norm(end.vel, axis=2).max() <= 2 + 1e-12


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ((Pursue(weight=1, group=3, radius=5),), "effects[0].group = 3: there are 2 groups"),
        ((Interpose(weight=1, group=0, other=2, radius=5, slow_radius=1),), "effects[0].other = 2: there are 2 groups"),
        ((Seek(weight=1, target=(0, 0)),), "effects[0].speed = None: groups[1].max_speed is not given either"),
        (
            (Steer(group=1, behaviours=(Wander(weight=1),)),),
            "effects[0].behaviours[0].speed = None: groups[1].max_speed is not given either",
        ),
        (
            (Seek(weight=1, target=(0, 0, 0), speed=1),),
            "effects[0].target = (0.0, 0.0, 0.0): has 3 numbers, but dimension = 2",
        ),
    ],
)
def test_a_behaviour_that_does_not_fit_its_scene_is_refused_in_one_line(effects: Any, message: str) -> None:
    groups = (Group(count=1, max_speed=2, spawn=ANYWHERE), Group(count=1, spawn=ANYWHERE))
    with pytest.raises(ValueError, match="effects") as caught:
        scene_of(*effects, groups=groups)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    Scene(groups=groups, effects=(Steer(group=0, behaviours=(Wander(weight=1),)),))  # max_speed of group 0 is given


def test_a_direction_of_zero_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"heading = \(0.0, 0.0\): must be a direction"):
        Face(weight=1, heading=(0, 0))
    with pytest.raises(ValueError, match=r"direction = \(0.0, 0.0\): must be a direction"):
        Dock(weight=1, target=(0, 0), direction=(0, 0), gate=1, width=1, slow_radius=1)
