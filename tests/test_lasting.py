"""Success in tasks that only the time limit ends: the aim must hold for a share of the settled decisions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.players import load_player
from flockenv.tasks import TASKS, Corridor, Flock, Task
from flockenv.tasks.lasting import LastingTask

pytestmark = pytest.mark.filterwarnings("ignore::flockenv.core.warnings.OtherTaskWarning")

WORLDS = 12
LASTING = tuple(kind for kind in TASKS.values() if issubclass(kind, LastingTask))

Played = dict[str, Any]


def play(
    task: Task, skilled: Callable[[int], bool] = lambda k: True, each: Callable[[World], Any] | None = None
) -> Played:
    """Play one episode, skilled in some decisions and random in the others; return the measures of every decision."""
    players = {True: load_player("rules", task), False: load_player("random", task)}
    world = World(task, WORLDS, task.horizon)
    seen = world.reset(5)
    success, now, held, seen_of = [], [], [], []
    for k in range(task.horizon):
        rows = seen.reshape(-1, seen.shape[-1])
        action, _ = players[skilled(k)].predict(rows, None, np.full(len(rows), k == 0), True)
        step = world.step(action.reshape(WORLDS, task.learners, -1))
        seen, found = step.observation.copy(), world.measure()
        success.append(step.success.copy())
        now.append(found["success_at_end"])
        held.append(found["held"])
        seen_of.append(each(world) if each is not None else None)
    return {"success": np.array(success), "now": np.array(now) == 1, "held": np.array(held), "each": seen_of}


def polarised(world: World) -> np.ndarray:
    """Return by world whether the flock is aligned and moves: the aim of Flock without the condition on contacts."""
    v = world.state.vel  # (B, N, 2) m/s
    course = v / np.linalg.norm(v, axis=-1, keepdims=True)
    order = np.linalg.norm(course.mean(axis=1), axis=-1)
    along = (v * np.swapaxes(world.memory, 1, 2)).sum(axis=-1).mean(axis=-1)
    return np.asarray((order > 0.9) & (along > 0.8 * world.task.cruise))


def test_corridor_and_flock_are_the_tasks_that_only_the_time_limit_ends() -> None:
    assert set(LASTING) == {Corridor, Flock}


@pytest.mark.parametrize("kind", LASTING)
@pytest.mark.parametrize(("settling", "lasting"), [(5.0, 0.9), (0.0, 0.5), (2.0, 1.0), (0.25, 0.96)])
def test_success_depends_on_the_share_of_settled_decisions_in_which_the_aim_holds(
    kind: type[LastingTask], settling: float, lasting: float
) -> None:
    task = kind(horizon=80, settling=settling, lasting=lasting)
    found = play(task)
    first = int(np.ceil(settling / task.control_dt - 1e-9))
    share = np.cumsum(found["now"][first:], axis=0) / np.arange(1, 81 - first)[:, None]
    np.testing.assert_allclose(found["held"][first:], share, atol=1e-12)
    assert np.isnan(found["held"][:first]).all()
    np.testing.assert_array_equal(found["success"][first:], share >= lasting - 1e-9)
    assert not found["success"][:first].any()


def test_the_aim_of_a_flock_is_aligned_motion_without_contacts() -> None:
    found = play(Flock(agents=8, obstacle_count=0, horizon=60), each=polarised)
    missing = np.array(found["each"]) & ~found["now"]
    assert not (found["now"] & ~np.array(found["each"])).any()
    assert missing.mean() < 0.02, "only contacts make the difference, and the rules have few"
    assert found["now"].any() and not found["now"].all()


@pytest.mark.parametrize("kind", LASTING)
def test_the_last_decision_alone_does_not_determine_success(kind: type[LastingTask]) -> None:
    """A player is skilled until shortly before the end and then random; another is random and skilled at the end."""
    few: dict[str, Any] = {"people": 12} if kind is Corridor else {}  # with few, the rules succeed in all worlds
    task = kind(horizon=150, **few)
    lost = play(task, lambda k: k < 146)
    assert kind is Flock or not lost["now"][-1].any(), "in a corridor, four random decisions change the speed"
    assert lost["success"][-1].mean() > 0.7
    late = play(task, lambda k: k >= 120)
    assert late["now"][-1].mean() > 0.7
    assert not late["success"][-1].any()


@pytest.mark.parametrize("kind", LASTING)
def test_an_episode_that_ends_before_agents_settle_is_no_success(kind: type[LastingTask]) -> None:
    task = kind(horizon=20, settling=2.0)
    found = play(task)
    assert not found["success"].any() and np.isnan(found["held"]).all()
    assert found["now"][-1].any()


@pytest.mark.parametrize("kind", LASTING)
@pytest.mark.parametrize(
    ("field", "value"), [("settling", -1.0), ("settling", float("nan")), ("lasting", 0.0), ("lasting", 1.5)]
)
def test_a_share_or_time_out_of_range_is_refused(kind: type[LastingTask], field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        kind(**{field: value})


@pytest.mark.slow
@pytest.mark.parametrize("kind", LASTING)
def test_both_precisions_count_from_the_same_decision(kind: type[LastingTask]) -> None:
    counted = []
    for dtype in ("float64", "float32"):
        world = World(kind(dtype=dtype, settling=0.7, horizon=30), 1, 30)
        world.reset(0)
        for k in range(30):
            world.step(np.zeros((1, world.learners, 2)))
            if "held" in world.metrics():
                counted.append(k)
                break
    assert counted == [7, 7]
