"""The task Evade: sight past cover, pursuit and search, contact with cover, rewards and the end of an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import Step, World
from flockenv.evaluation import rollout
from flockenv.players.rules import RulesPlayer, player
from flockenv.players.rules.evade import EscapeRules, EvadeRules, escape
from flockenv.tasks import Evade

FAR = (27.0, 27.0)


def scene(evader: Any, *pursuers: Any, cover: Any = (), **fields: Any) -> World:
    """Return a world with all agents at rest at the given positions; cover is (x, y, radius)."""
    world = World(Evade(pursuers=len(pursuers), **fields))
    world.reset(3)
    world.state.pos[0], world.state.vel[0] = [evader, *pursuers], 0.0
    world.state.obstacle_radius[0] = 0.0
    for m, (x, y, radius) in enumerate(cover):
        world.state.obstacles.centre[0, m], world.state.obstacle_radius[0, m] = (x, y), radius
    return world


def act(world: World, action: Any = (0.0, 0.0)) -> Step:
    return world.step(np.asarray(action, float).reshape(1, 1, 2))


def seen(world: World) -> Any:
    """Return the current observation of the evader by slot name."""
    rows = world.reset(mask=np.zeros(1, bool))
    return world.task.layout.unpack(rows[0, 0])


def paid(world: World, step: Step) -> dict[str, float]:
    return dict(zip(world.task.terms, step.terms[0, 0].tolist(), strict=True))


@pytest.mark.parametrize(
    ("cover", "visible"),
    [
        ((), True),
        (((10.0, 14.0, 1.0),), False),
        (((10.0, 15.01, 1.0),), True),  # the line of sight just misses it
        (((10.0, 14.99, 1.0),), False),
        (((4.5, 14.0, 1.0),), True),  # behind the evader
        (((15.5, 14.0, 1.0),), True),  # behind the pursuer
        (((5.5, 14.0, 1.0), (20.0, 5.0, 1.5)), True),
    ],
)
def test_only_cover_on_the_straight_line_blocks_sight(cover: Any, visible: bool) -> None:
    world = scene((6.6, 14.0), (13.4, 14.0), FAR, FAR, cover=cover)
    assert bool(seen(world).seen[0]) == visible


def test_a_pursuer_sees_the_evader_only_within_its_sight() -> None:
    assert seen(scene((2.0, 14.0), (11.99, 14.0), FAR, FAR)).seen[0] == 1
    assert seen(scene((2.0, 14.0), (12.01, 14.0), FAR, FAR)).seen[0] == 0


def test_a_pursuer_without_sight_of_the_evader_goes_to_the_last_seen_position() -> None:
    world = scene((10.0, 4.0), (10.0, 12.0), FAR, FAR)
    act(world)
    last = world.state.pos[0, 0].copy()
    world.state.obstacles.centre[0, 0], world.state.obstacle_radius[0, 0] = (15.0, 8.0), 1.8
    world.state.pos[0, 0] = (20.0, 4.0)  # far to the side, behind the new cover
    world.state.pos[0, 2:] = FAR
    for _ in range(12):
        world.state.pos[0, 0], world.state.vel[0, 0] = (20.0, 4.0), 0.0
        act(world)
        assert seen(world).seen.sum() == 0
    heading = world.state.vel[0, 1] / np.linalg.norm(world.state.vel[0, 1])
    offset = last - world.state.pos[0, 1]
    assert heading @ (offset / np.linalg.norm(offset)) > 0.99


def test_a_searching_pursuer_looks_behind_cover() -> None:
    """It has never seen the evader; within 8 s it reaches the far side of the only obstacle."""
    world = scene((1.0, 27.0), (14.0, 8.0), FAR, FAR, cover=((14.0, 14.0, 1.5),), sight=3.0)
    world.state.pos[0, 2:] = (27.0, 1.0)
    highest = 0.0
    for _ in range(80):
        act(world)
        highest = max(highest, float(world.state.pos[0, 1, 1]))
    assert highest > 15.5


def test_pursuers_head_for_the_predicted_position_of_the_evader() -> None:
    """Interception looks at most 1 s ahead: an evader that runs along x at 2 m/s is led by 2 m."""
    world = scene((8.0, 4.0), (8.0, 12.0), FAR, FAR)
    world.state.vel[0, 0] = (2.0, 0.0)
    act(world)
    velocity = world.state.vel[0, 1]
    assert velocity[0] / -velocity[1] == pytest.approx(2.0 / 8.0, rel=1e-6)


def test_a_capture_costs_once_and_ends_the_episode_and_free_time_is_rewarded() -> None:
    world = scene((10.0, 10.0), (11.5, 10.0), FAR, FAR)
    step = act(world, (0.6, 0.8))
    terms = paid(world, step)
    assert terms == pytest.approx({"alive": 0.1, "caught": 0.0, "effort": -0.1 * 0.1})
    assert step.success.all()
    assert not step.terminated.any()
    world.state.pos[0, 1] = world.state.pos[0, 0] + [0.6, 0.0]
    step = act(world)
    assert paid(world, step) == pytest.approx({"alive": 0.0, "caught": -10.0, "effort": 0.0})
    assert step.terminated.all()
    assert not step.success.any()
    measured = world.measure()
    assert measured["survived"] == 0
    assert measured["survival_time"] == pytest.approx(0.2)


def test_time_hidden_is_the_time_in_which_no_pursuer_sees_the_evader() -> None:
    cover = ((10.0, 14.0, 1.5),)
    world = scene((6.0, 14.0), (14.0, 14.0), FAR, FAR, cover=cover)
    for k in range(5):
        world.state.pos[0] = [(6.0, 14.0), (14.0, 14.0), FAR, FAR]
        world.state.vel[0] = 0.0
        act(world)
        assert world.measure()["time_hidden"] == pytest.approx(0.1 * (k + 1))
    world.state.pos[0, 1] = (6.0, 9.0)
    act(world)
    assert world.measure()["time_hidden"] == pytest.approx(0.5)


def test_cover_stops_an_evader_that_runs_into_it() -> None:
    world = scene((5.0, 14.0), FAR, FAR, FAR, cover=((10.0, 14.0, 1.5),))
    deepest = 0.0
    for _ in range(60):
        world.state.pos[0, 1:] = FAR
        act(world, (1.0, 0.0))
        deepest = max(deepest, float(world.state.pos[0, 0, 0]))
    assert 10.0 - 1.8 < deepest < 10.0 - 1.8 + 0.25
    assert world.state.pos[0, 0, 0] == pytest.approx(8.2 + 8.0 / 400.0, abs=0.02)  # pressed in by 8 N


def test_pursuers_stay_out_of_cover_and_below_their_maximum_speed() -> None:
    world = World(Evade(), 32)
    world.reset(5)
    rng, s, deepest, fastest = np.random.default_rng(1), world.state, [], 0.0
    for _ in range(100):
        step = world.step(rng.uniform(-1, 1, (32, 1, 2)))
        gone = s.pos[:, 1:, None] - s.obstacles.centre[:, None]
        gap = np.linalg.norm(gone, axis=3) - s.obstacle_radius[:, None] - 0.3
        deepest.append(np.where(s.obstacle_radius[:, None] > 0, gap, np.inf).min())
        fastest = max(fastest, np.linalg.norm(s.vel[:, 1:], axis=2).max())
        world.reset(mask=step.ended)
    assert min(deepest) > -0.2
    assert 2.1 < fastest <= 2.2 * (1 + 1e-9)


def test_agents_start_clear_of_cover_and_of_each_other() -> None:
    world = World(Evade(), 100)
    world.reset(3)
    s = world.state
    assert (s.obstacle_radius > 0).sum(axis=1).min() >= 6
    gone = np.linalg.norm(s.pos[:, :, None] - s.obstacles.centre[:, None], axis=3) - s.obstacle_radius[:, None]
    assert np.where(s.obstacle_radius[:, None] > 0, gone, np.inf).min() > 0.3
    assert np.linalg.norm(s.pos[:, 1:] - s.pos[:, :1], axis=2).min() >= 8.0
    assert not s.vel.any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"least_radius": 3.0}, "least_radius = 3"),
        ({"greatest_radius": 13.0}, "field of 28 m"),
        ({"start_distance": 20.0}, "start_distance = 20"),
        ({"pursuers": 0}, "pursuers = 0"),
    ],
)
def test_invalid_fields_are_refused_in_one_line(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Evade(**fields)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- the hand-written player ------------------------------------------------------------------------------------------


def course(world: World, p: EscapeRules = EscapeRules()) -> Any:  # noqa: B008  # frozen
    """Return the force of the escape at the present state, N."""
    rows = world.reset(mask=np.zeros(1, bool))
    return escape(world.task.layout.unpack(rows[0]), world.task, p)[0]


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.2, 4.0, 5.5])
def test_the_escape_flees_from_a_single_pursuer(angle: float) -> None:
    direction = np.array([np.cos(angle), np.sin(angle)])
    force = course(scene((14.0, 14.0), (14.0, 14.0) + 3.0 * direction))
    assert force @ direction < -0.9 * np.linalg.norm(force)
    assert np.linalg.norm(force) == pytest.approx(5.0 * 3.0)  # gain x speed, from rest


def test_the_escape_saves_effort_if_there_is_no_danger() -> None:
    near, far = (np.linalg.norm(course(scene((4.0, 14.0), (4.0 + d, 14.0)))) for d in (4.0, 20.0))
    assert far < 0.01 * near


def test_the_escape_runs_along_a_wall_and_not_into_it() -> None:
    force = course(scene((27.4, 10.0), (24.4, 10.0)))
    assert abs(force[1]) > 3 * abs(force[0])


def test_the_escape_prefers_the_course_that_ends_behind_cover() -> None:
    """Cover beside the straight course away from the pursuer hides the end of a course on its side."""
    for side in (1.0, -1.0):
        world = scene((14.0, 14.0), (8.5, 14.0), cover=((13.0, 14.0 + side * 1.9, 0.7),))
        hidden = course(world, EscapeRules(reach=1.0, exposed=2.0))
        assert side * hidden[1] > 0.3 * np.linalg.norm(hidden)
        assert abs(course(world, EscapeRules(reach=1.0, exposed=0.0))[1]) < 1e-9


def test_parameters_of_the_escape_may_differ_by_row() -> None:
    task = Evade()
    rows = np.random.default_rng(0).uniform(0, 1, (6, task.layout.size)).astype(np.float32)
    seen, other = task.layout.unpack(rows), EscapeRules(1.0, 1.0, 0.9, 1.5, 1.5, 2.0, 0.3, 8.0)
    first, second = (escape(seen, task, p) for p in (EscapeRules(), other))
    mixed = EscapeRules(*(
        np.where(np.arange(6) < 3, a, b)
        for a, b in zip(vars(EscapeRules()).values(), vars(other).values(), strict=True)
    ))  # fmt: skip
    np.testing.assert_array_equal(escape(seen, task, mixed), np.vstack([first[:3], second[3:]]))


def test_the_escape_is_caught_less_often_than_the_textbook() -> None:
    task = Evade()
    assert player(task, "textbook").rules == EvadeRules()
    escaping, hiding = (rollout(task, RulesPlayer(task, rules, name), 64, 7) for rules, name in (
        (EscapeRules(), "rules"), (EvadeRules(), "textbook")))  # fmt: skip
    assert escaping.success.mean() > hiding.success.mean() + 0.15
    assert escaping.returns.mean() > hiding.returns.mean() + 3
