"""PathFollow: the track, the observation and the reward on it, and its hand-written player."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import Step, World
from flockenv.evaluation import rollout
from flockenv.geometry import polyline
from flockenv.players.rules import RulesPlayer, player
from flockenv.players.rules.path_follow import (
    PathFollowRules,
    RacingRules,
    allowed_speeds,
    race,
    racing_line,
)
from flockenv.render.picture import draw
from flockenv.tasks import PathFollow
from flockenv.tasks.path_follow import POINTS
from tests.catalogue import Array

TASK = PathFollow()
CAREFUL = PathFollowRules(time=0.2, lead=0.3, tube=0.1, keep=0.95, grip=0.8, early=0.6, brake=8.0, gain=8.0)


def corners(world: World, k: int = 0) -> Array:
    """Return the track's corners, (P, 2) m, in the order in which they are passed."""
    return np.asarray(world._memory[: 2 * POINTS, k, 0].reshape(2, POINTS).T, float)


def ways(track: Array) -> tuple[Array, Array]:
    """Return the unit vectors and lengths of its pieces."""
    along = np.roll(track, -1, axis=0) - track
    size = np.linalg.norm(along, axis=1)
    return along / size[:, None], size


def left_of(way: Array) -> Array:
    return np.stack([-way[..., 1], way[..., 0]], axis=-1)


def crossed(a: Array, b: Array) -> Array:
    """Return the sines of the angles from a to b, which are unit vectors."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def world_of(seed: int = 3, worlds: int = 1) -> World:
    world = World(TASK, worlds)
    world.reset(seed)
    return world


def at(world: World, place: Any, velocity: Any = (0.0, 0.0)) -> None:
    world.state.pos[0, 0], world.state.vel[0, 0] = place, velocity


def seen(step: Step) -> Any:
    return TASK.layout.unpack(step.observation[0, 0])


def stay(world: World) -> Step:
    """Make a decision without any force."""
    return world.step(np.zeros((world.worlds, 1, 2)))


# --- the track --------------------------------------------------------------------------------------------------------


def test_a_track_depends_on_the_seed_alone_and_lies_in_the_field() -> None:
    world, again = world_of(5, 64), world_of(5, 64)
    np.testing.assert_array_equal(world._memory, again._memory)
    tracks = np.stack([corners(world, k) for k in range(64)])
    assert len(np.unique(tracks[:, 0, 0])) == 64
    assert tracks.min() > TASK.lost_distance
    assert tracks.max() < TASK.size - TASK.lost_distance
    x, y = (tracks - TASK.size / 2).transpose(2, 0, 1)
    area = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    assert 20 < (area > 0).sum() < 44  # some tracks run clockwise, some do not
    began = np.linalg.norm(tracks - world.state.pos, axis=2).min(axis=1)
    np.testing.assert_allclose(began, 0, atol=1e-12)


def test_offset_and_velocity_are_observed_in_the_frame_of_the_nearest_piece() -> None:
    world = world_of()
    track = corners(world)
    way, size = ways(track)
    for k in range(0, POINTS, 5):
        middle, left = track[k] + 0.5 * size[k] * way[k], left_of(way[k])
        for off in (-0.3, 0.2):
            at(world, middle + off * left - 0.1 * (1.5 * way[k] - 0.5 * left), 1.5 * way[k] - 0.5 * left)
            found = seen(stay(world))
            assert found.left == pytest.approx(off, abs=1e-5)
            np.testing.assert_allclose(found.velocity, (1.5, -0.5), atol=1e-5)


def test_the_observed_points_ahead_and_curvatures_are_those_of_the_track() -> None:
    world = world_of()
    track = corners(world)
    way, size = ways(track)
    k = 100  # the points ahead lie across the seam
    at(world, track[k] + 0.5 * size[k] * way[k])
    found = seen(stay(world))
    order = (np.arange(POINTS) + k) % POINTS
    lengths = np.concatenate([[0], np.cumsum(size[order])])
    loop = np.vstack([track[order], track[k]])
    s = 0.5 * size[k] + TASK.spacing * (1 + np.arange(TASK.ahead))
    points = np.stack([np.interp(s, lengths, loop[:, axis]) for axis in range(2)], axis=1)
    offset = points - world.state.pos[0, 0]
    expected = np.stack([offset @ way[k], offset @ left_of(way[k])], axis=1)
    np.testing.assert_allclose(found.points, expected, atol=1e-5)
    turn = crossed(way, np.roll(way, -1, axis=0))  # at the end of each piece
    mean = np.arcsin(turn) / (0.5 * (size + np.roll(size, -1)))
    corner = np.interp(s, lengths, np.append(np.roll(mean, 1)[order], np.roll(mean, 1)[k]))
    np.testing.assert_allclose(found.curvature, corner, atol=0.03)
    assert np.abs(corner).max() > 0.1


# --- the reward -------------------------------------------------------------------------------------------------------


def test_the_progress_reward_is_the_distance_covered_along_the_track() -> None:
    """The distance is that of flockenv.geometry.polyline, over a whole episode; success needs a full lap."""
    world = world_of()
    track = polyline.pieces(corners(world).tolist(), closed=True)
    length, careful = track[1], RulesPlayer(TASK, CAREFUL, "textbook")
    s, gone = polyline.project(track, world.state.pos[0, 0])[0], 0.0
    observation = world.reset(3)
    for _ in range(TASK.horizon):
        step = world.step(careful.predict(observation[:, 0])[0][:, None])
        observation = step.observation
        now = polyline.project(track, world.state.pos[0, 0])[0]
        gained = (now - s + length / 2) % length - length / 2
        s, gone = now, gone + gained
        assert step.terms[0, 0, 0] == pytest.approx(TASK.progress_reward * gained, abs=1e-9)
        assert step.success[0] == (gone >= length)
    assert gone > 1.2 * length
    assert world.measure()["progress"][0] == pytest.approx(gone)


def test_an_agent_moved_to_another_piece_is_found_there() -> None:
    """The piece is stored from step to step, but it must be that of the present position."""
    world = world_of()
    world.step(np.zeros((1, 1, 2)))
    track = corners(world)
    way, _ = ways(track)
    place, across = (track[40] + track[41]) / 2, 0.3 * left_of(way[40])
    at(world, place + across)
    row = world.reset(mask=np.zeros(1, bool))[0, 0]  # restarts no episode, only observes
    assert row[2] == pytest.approx(0.3 / TASK.lost_distance, abs=1e-5)
    step = world.step(np.array([[[1.0, 0.0]]]))  # along the track there
    gone = world.state.pos[0, 0] - place - across
    assert gone @ way[40] == pytest.approx(np.linalg.norm(gone), rel=1e-6)
    assert step.terms[0, 0, 0] == pytest.approx(TASK.progress_reward * (gone @ way[40]), rel=1e-3)


def test_a_full_lap_is_a_success_and_does_not_end_the_episode() -> None:
    world = world_of()
    world._memory[3 * POINTS + 1, 0, 0] = world._memory[3 * POINTS, 0, 0] - 0.05  # all but 0.05 m of the lap
    track = corners(world)
    way, _ = ways(track)
    at(world, track[7] + 0.01 * way[7])
    assert not stay(world).success[0]
    at(world, track[7] + 0.01 * way[7], 1.0 * way[7])
    assert stay(world).success[0]
    assert world.state.alive[0, 0]


def test_moving_backwards_costs_as_much_as_moving_forwards_gains() -> None:
    world = world_of()
    track = corners(world)
    way, size = ways(track)
    for k in (20, POINTS - 1):
        middle = track[k] + 0.5 * size[k] * way[k]
        there = []
        for sign in (1, -1):
            at(world, middle, sign * 1.0 * way[k])
            there.append(stay(world).terms[0, 0, 0])
        assert there[0] == pytest.approx(0.1 * TASK.progress_reward)
        assert there[1] == pytest.approx(-there[0])


def test_leaving_the_track_costs_and_going_far_off_ends_the_episode() -> None:
    world = world_of()
    track = corners(world)
    way, size = ways(track)
    k = int(np.argmin(np.abs(crossed(way, np.roll(way, -3, axis=0)))))  # the straightest piece
    middle, left = track[k] + 0.5 * size[k] * way[k], left_of(way[k])
    for off, expected, over in (
        (TASK.half_width - 0.02, (0.0, 0.0), False),
        (TASK.half_width + 0.02, (-TASK.off_cost * TASK.control_dt, 0.0), False),
        (-TASK.half_width - 0.02, (-TASK.off_cost * TASK.control_dt, 0.0), False),
        (TASK.lost_distance + 0.1, (-TASK.off_cost * TASK.control_dt, -TASK.lost_cost), True),
    ):
        at(world, middle + off * left)
        step = stay(world)
        np.testing.assert_allclose(step.terms[0, 0, 1:], expected)
        assert step.terminated[0, 0] == over
        assert not step.success[0]


def test_actions_are_forces_in_the_frame_of_the_track() -> None:
    world = world_of()
    track = corners(world)
    way, size = ways(track)
    for k in (3, 60):
        for action, expected in (((1, 0), way[k]), ((0, 1), left_of(way[k]))):
            at(world, track[k] + 0.5 * size[k] * way[k])
            world.step(np.array(action, float).reshape(1, 1, 2))
            np.testing.assert_allclose(world.state.vel[0, 0], 0.1 * TASK.max_force * expected, atol=1e-12)


def test_a_picture_shows_the_track() -> None:
    world = world_of()
    shot = world.snapshot(0)
    assert [mark.kind for mark in shot.marks] == ["way"] * POINTS
    np.testing.assert_allclose([mark.at for mark in shot.marks], corners(world))
    assert world.snapshot().marks is shot.marks  # made once per track
    single = World(PathFollow(dtype="float32"), 1)
    single.reset(3)
    np.testing.assert_allclose([mark.at for mark in single.snapshot().marks], corners(single), rtol=1e-6)
    with_track, without = draw(shot, 300), draw(dataclasses.replace(shot, marks=()), 300)
    share = (with_track != without).any(axis=2).mean()
    _, size = ways(corners(world))
    assert share == pytest.approx(2 * TASK.half_width * size.sum() / TASK.size**2, rel=0.25)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"half_width": 3.0}, "lost_distance = 2.5: must be more than half_width = 3"),
        ({"ring": 6.0}, "lost_distance = 2.5: at most 0.3 of ring = 6"),
        ({"ahead": 64}, "spacing = 1.2: 64 points span 76.8 m; at most half a ring"),
        ({"winding": 0.9}, "winding = 0.9"),
    ],
)
def test_invalid_parameters_are_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        PathFollow(**change)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- the hand-written player ------------------------------------------------------------------------------------------


def test_a_player_that_brakes_before_bends_stays_on_the_track_unlike_the_textbook() -> None:
    found = {name: rollout(TASK, RulesPlayer(TASK, rules, "textbook"), 32, 7) for name, rules in (
        ("careful", CAREFUL), ("textbook", PathFollowRules()))}  # fmt: skip
    assert found["careful"].success.all()
    assert found["careful"].metrics["off_track"].max() < 0.02
    assert found["careful"].metrics["progress"].min() > 120
    assert found["textbook"].success.mean() < 0.5
    assert found["careful"].returns.mean() > found["textbook"].returns.mean() + 20


def view(points: Any, left: float = 0.0, velocity: Any = (0.0, 0.0)) -> Any:
    """Return one row of an observation: the points ahead (ahead, 2) m, the offset to the left, the velocity."""
    return SimpleNamespace(points=np.array([points], float), left=np.array([left]), velocity=np.array([velocity]))


STRAIGHT = TASK.spacing * np.stack([1.0 + np.arange(TASK.ahead), np.zeros(TASK.ahead)], axis=1)
CORNER = TASK.spacing * np.array([(1, 0), (2, 0), (3, 0), (4, 0), (4, 1), (4, 2), (4, 3), (4, 4)], float)


def test_the_racing_line_of_a_straight_track_is_straight_and_run_at_full_speed() -> None:
    aside = racing_line(view(STRAIGHT - (0.0, 0.3), 0.3, (5.0, 0.0)), TASK, RacingRules())[0, 1:]
    np.testing.assert_allclose(aside[:, 1], np.linspace(0.0, aside[-1, 1], len(aside)), atol=0.05)
    assert np.abs(aside[1:, 1] + 0.3).max() <= 0.9 * TASK.half_width
    straight = racing_line(view(STRAIGHT), TASK, RacingRules())
    np.testing.assert_allclose(straight[0, 1:], np.vstack([[0.0, 0.0], STRAIGHT]), atol=1e-9)
    np.testing.assert_allclose(allowed_speeds(straight, TASK, RacingRules()), TASK.max_speed)
    np.testing.assert_allclose(race(view(STRAIGHT), TASK, RacingRules()), [[10.0 * TASK.max_speed, 0.0]])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_racing_line_cuts_a_corner_within_the_width(side: float) -> None:
    corner = CORNER * (1.0, side)
    line = racing_line(view(corner, velocity=(4.0, 0.0)), TASK, RacingRules(width=0.8))[0]
    moved, limit = line[2:] - corner, 0.8 * TASK.half_width
    assert np.linalg.norm(moved, axis=1).max() <= limit + 1e-9
    inwards = np.array([-1.0, side]) / np.sqrt(2.0)
    assert moved[3] @ inwards == pytest.approx(limit)  # the corner itself is cut as far as allowed
    assert side * moved[1, 1] < -0.1 and moved[5, 0] > 0.1  # from the outside to the outside
    middle = np.vstack([line[:2], corner])
    bending, straight_bending = (np.square(np.diff(each, n=2, axis=0)[1:]).sum() for each in (line, middle))
    assert bending < 0.5 * straight_bending


def test_no_other_line_within_the_width_bends_less() -> None:
    """The offsets are compared with those of scipy's bounded least squares."""
    from scipy.optimize import lsq_linear

    line = racing_line(view(CORNER, velocity=(4.0, 0.0)), TASK, RacingRules(width=0.8))[0, 1:]
    tangent = np.gradient(np.vstack([[0.0, 0.0], CORNER]), axis=0)[1:]
    side = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1)[:, None]
    second = np.diff(np.eye(TASK.ahead + 1), n=2, axis=0)
    columns = np.stack([(second[:, k + 1, None] * side[k]).ravel() for k in range(TASK.ahead)], axis=1)
    limit = 0.8 * TASK.half_width
    best = lsq_linear(columns, -(second @ np.vstack([[0.0, 0.0], CORNER])).ravel(), (-limit, limit))
    assert np.square(second @ line).sum() == pytest.approx(2.0 * best.cost, rel=2e-3)


def test_speed_in_a_bend_and_before_it_stays_within_the_friction_circle() -> None:
    radius, turn = 2.0, 0.6 * np.arange(5)
    bend = radius * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=1)
    line = np.vstack([[(x, 0.0) for x in (-6.0, -4.8, -3.6, -2.4, -1.2)], bend])[None]
    p = RacingRules(late=1.0)
    speed = allowed_speeds(line, TASK, p)[0]
    assert speed.shape == (TASK.ahead,)
    np.testing.assert_allclose(speed[5:], np.sqrt(TASK.max_force * radius))  # v^2 / r = F / m
    assert speed[0] == TASK.max_speed
    assert (np.diff(speed[:6]) <= 0.0).all() and np.diff(speed[:6]).min() < -0.5
    length = np.linalg.norm(np.diff(line[0], axis=0), axis=1)[1:]
    braking = -np.diff(speed**2) / (2.0 * length[: len(speed) - 1])
    across = np.zeros(len(speed) - 1)
    across[4:] = speed[5:] ** 2 / radius
    assert np.hypot(braking, across).max() <= TASK.max_force * (1 + 1e-9)
    assert np.hypot(braking[1:4], across[1:4]).max() == pytest.approx(TASK.max_force)
    np.testing.assert_allclose(allowed_speeds(line, TASK, RacingRules(grip=0.5))[0, 5:], np.sqrt(8.0))


def test_parameters_may_differ_by_row() -> None:
    rows = np.random.default_rng(0).uniform(-1, 1, (6, TASK.layout.size)).astype(np.float32)
    seen, other = TASK.layout.unpack(rows), RacingRules(width=0.6, course=0.5, grip=1.2, brake=0.7, late=1, lead=0.2)
    first, second = (race(seen, TASK, p) for p in (RacingRules(), other))
    mixed = RacingRules(**{
        name: np.where(np.arange(6) < 3, a, b)
        for (name, a), b in zip(vars(RacingRules()).items(), vars(other).values(), strict=True)
    })  # fmt: skip
    np.testing.assert_array_equal(race(seen, TASK, mixed), np.vstack([first[:3], second[3:]]))


def test_the_racing_line_is_faster_than_braking_on_the_middle_line() -> None:
    assert player(TASK).rules.__class__ is RacingRules
    assert player(TASK, "textbook").rules == PathFollowRules()
    racing, careful = (rollout(TASK, RulesPlayer(TASK, rules, name), 32, 7) for rules, name in (
        (RacingRules(), "rules"), (CAREFUL, "textbook")))  # fmt: skip
    assert racing.success.all()
    assert racing.metrics["off_track"].max() < 0.02
    assert (racing.returns - careful.returns).min() > 2


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [1, 3])
def test_rules_play_with_few_points_ahead(ahead: int) -> None:
    task = PathFollow(ahead=ahead)
    rows = World(task, 4).reset(0).reshape(4, -1)
    action, _ = player(task).predict(rows)
    assert np.isfinite(action).all() and (np.linalg.norm(action, axis=1) > 0.1).all()
