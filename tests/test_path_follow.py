"""PathFollow: the track, the observation and the reward on it, and its hand-written player."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import Step, World
from flockenv.evaluation import rollout
from flockenv.geometry import polyline
from flockenv.players.rules import RulesPlayer
from flockenv.players.rules.path_follow import PathFollowRules
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
    length, player = track[1], RulesPlayer(TASK, CAREFUL)
    s, gone = polyline.project(track, world.state.pos[0, 0])[0], 0.0
    observation = world.reset(3)
    for _ in range(TASK.horizon):
        step = world.step(player.predict(observation[:, 0])[0][:, None])
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
    found = {name: rollout(TASK, RulesPlayer(TASK, rules), 32, 7) for name, rules in (
        ("careful", CAREFUL), ("textbook", PathFollowRules()))}  # fmt: skip
    assert found["careful"].success.all()
    assert found["careful"].metrics["off_track"].max() < 0.02
    assert found["careful"].metrics["progress"].min() > 120
    assert found["textbook"].success.mean() < 0.5
    assert found["careful"].returns.mean() > found["textbook"].returns.mean() + 20
