"""Observations and rewards of the tasks: exact values in hand-made states, and properties of every task."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import njit

import flockenv
from flockenv.envs.world import Step, World
from flockenv.jit.simd_rows import PAIR
from flockenv.physics.integrators import RK4, Midpoint, SemiImplicitEuler
from flockenv.tasks import TASKS, Crossing, Flock, Obstacles, Pursuit, Task, flock
from flockenv.tasks.play import name_of
from tests.catalogue import TASKS as ROWS
from tests.catalogue import TaskRow

EVERY = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


def world_of(task: Task, seed: int = 3, worlds: int = 1) -> World:
    world = World(task, worlds)
    world.reset(seed)
    return world


def place(world: World, pos: Any, vel: Any = 0.0) -> None:
    world.state.pos[0], world.state.vel[0] = pos, vel


def act(world: World, action: Any = 0.0) -> Step:
    """Step the only world, with the same action for all learners."""
    return world.step(np.broadcast_to(np.asarray(action, float), (1, world.learners, world.action_size)))


def paid(world: World, step: Step, learner: int = 0) -> dict[str, float]:
    return dict(zip(world.task.terms, step.terms[0, learner].tolist(), strict=True))


def random_actions(world: World, steps: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    wanted = rng.uniform(-1, 1, (steps // 10 + 1, world.worlds, world.learners, world.action_size))
    return np.repeat(wanted, 10, axis=0)[:steps]  # each held for 10 steps, so that agents cover some distance


# --- what holds for every task ----------------------------------------------------------------------------------------


@EVERY
def test_reward_is_the_sum_of_its_named_terms(row: TaskRow) -> None:
    world = world_of(row.task, worlds=4)
    seen = np.zeros(len(row.task.terms), bool)
    for actions in random_actions(world, 200):
        step = world.step(actions)
        assert step.terms.shape == (4, row.task.learners, len(row.task.terms))
        np.testing.assert_array_equal(step.reward, step.terms.sum(axis=2))
        assert np.isfinite(step.terms).all()
        seen |= (step.terms != 0).any(axis=(0, 1))
    assert seen.any()


@EVERY
def test_an_observation_stays_in_its_space(row: TaskRow) -> None:
    world = world_of(row.task, worlds=4)
    low, high = row.task.layout.low, row.task.layout.high
    assert low.shape == high.shape == (world.observation_size,)
    for actions in random_actions(world, 1000):
        step = world.step(2 * actions)  # beyond the bounds, so that corners of the action space occur
        assert step.observation.dtype == np.float32
        assert step.observation.shape == (4, row.task.learners, world.observation_size)
        assert np.isfinite(step.observation).all()
        assert (step.observation >= low).all()
        assert (step.observation <= high).all()
        if step.ended.any():
            world.reset(mask=step.ended)


@EVERY
def test_a_task_is_a_value_with_distinct_names(row: TaskRow) -> None:
    task = row.task
    assert pickle.loads(pickle.dumps(task)) == task
    assert type(task).model_validate(task.model_dump()) == task
    names = {type(record).__name__: type(record) for record in (task, task.integrator)}
    assert eval(repr(task), names) == task  # noqa: S307
    assert TASKS[task.name] is type(task)
    assert len(task.agent_names) == len(set(task.agent_names)) == task.learners <= task.agents == task.scene.agents
    assert len(task.scene.roles) == task.agents
    world = world_of(task)
    assert list(world.measure()) == list(task.metric_names)
    assert len(set(task.metric_names)) == len(task.metric_names)
    slots = [slot.name for slot in task.layout.slots]
    assert len(slots) == len(set(slots))
    assert task.layout.size == sum(slot.size for slot in task.layout.slots)
    assert all(slot.meaning and slot.unit for slot in (*task.layout.slots, *task.action_layout.slots))
    assert set(row.task.counts) <= row.task.parameters().keys()


def test_kernels_are_compiled_for_their_loop_bounds_and_no_other_number() -> None:
    default = name_of(Flock())
    for name in ("neighbours", "obstacles_seen", "rays"):
        assert name_of(Flock(**{name: 5})) != default
    assert name_of(Flock(agents=5)) != default == name_of(Flock(agents=40))  # 5 agents: at most 4 neighbours
    assert name_of(Flock(touch_cost=3.0, sight=7.0, obstacle_count=2)) == default


@pytest.mark.slow
def test_loop_bounds_give_the_same_results_as_constants_and_as_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """In single precision, as policies learn in it: a number of the wrong type would promote its operands.

    Whether the norm in `alignment` is a fused operation varies, so its last bit may differ.
    """
    task = Flock(agents=5, neighbours=3, obstacles_seen=1, rays=8, dtype="float32")
    ends = []
    for counts in (Flock.counts, ()):
        monkeypatch.setattr(Flock, "counts", counts)
        world = world_of(task, worlds=3)
        steps = [world.step(actions) for actions in random_actions(world, 40)]
        ends.append((np.array([s.observation for s in steps]), np.array([s.terms for s in steps])))
    (seen, terms), (seen_given, terms_given) = ends
    np.testing.assert_array_equal(seen, seen_given)
    fused = Flock.terms.index("alignment")
    np.testing.assert_array_equal(np.delete(terms, fused, -1), np.delete(terms_given, fused, -1))
    np.testing.assert_allclose(terms[..., fused], terms_given[..., fused], rtol=2e-7, atol=1e-9)


def test_a_task_without_terms_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pursuit, "terms", ())
    with pytest.raises(TypeError, match=r"Pursuit\.terms is empty"):
        name_of(Pursuit())


def test_a_kernel_without_lanes_is_shared_by_all_numbers_of_learners() -> None:
    assert name_of(Crossing(agents=70, circle=20)) == name_of(Crossing(agents=60, circle=20))


def test_a_count_that_is_no_parameter_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Flock, "counts", ("ray",))
    with pytest.raises(TypeError, match=r"Flock\.counts: 'ray' is none of its parameters: .*rays"):
        name_of(Flock())


@EVERY
def test_the_integrator_of_a_task_does_not_change_its_layouts_and_parameters(row: TaskRow) -> None:
    task = row.task.model_copy(update={"integrator": {"kind": "midpoint"}})
    assert task.integrator == task.scene.integrator == Midpoint()
    assert row.task.integrator == row.task.scene.integrator == SemiImplicitEuler()
    assert task.layout.digest == row.task.layout.digest
    assert task.action_layout.digest == row.task.action_layout.digest
    assert task.parameters() == row.task.parameters()
    assert name_of(task) != name_of(row.task)


@pytest.mark.parametrize("names", [("path", "class"), ("_x",), ("pa th",), ("path", "path")])
def test_measures_that_are_no_valid_field_names_are_refused(
    names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Pursuit, "measures", names)
    with pytest.raises(TypeError, match=rf"Pursuit.measures: '{names[-1]}'"):
        name_of(Pursuit())


@pytest.mark.slow
def test_a_method_of_second_order_is_exact_for_a_constant_force() -> None:
    moved = {}
    for task in (Pursuit(), Pursuit(integrator=Midpoint())):
        world = world_of(task)
        place(world, [[5.0, 5.0], [15.0, 15.0]])
        act(world, (0.5, 0.0))
        moved[task.integrator.kind] = world.state.pos[0, 0, 0] - 5.0
    exact = 0.5 * (0.5 * task.pursuer_force) * task.control_dt**2
    assert moved["midpoint"] == pytest.approx(exact, rel=1e-12)
    assert moved["semi_implicit_euler"] == pytest.approx(exact * (1 + 1 / task.substeps), rel=1e-12)


@EVERY
def test_methods_that_solve_equations_in_python_are_refused_in_one_line(
    row: TaskRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RK4, "solves", True)
    with pytest.raises(ValueError, match=r".") as caught:
        type(row.task)(integrator=RK4())
    message = str(caught.value)
    assert "integrator.kind = 'rk4': solves equations in Python" in message
    allowed = message.split("allowed: ")[1].split(", ")
    assert "midpoint" in allowed
    assert "rk4" not in allowed
    assert "\n" not in message


@EVERY
@pytest.mark.parametrize("kind", ["typo", "clock", "backwards", "method"])
def test_bad_arguments_of_a_task_are_refused_in_one_line(row: TaskRow, kind: str) -> None:
    given, message = {
        "typo": ({"horizn": 5}, "did you mean `horizon`"),
        "clock": ({"control_dt": 0.1, "dt": 0.03}, "control_dt = 0.1 s is not a whole multiple of dt = 0.03 s"),
        "backwards": ({"dt": 0.2}, "whole multiple"),
        "method": ({"integrator": {"kind": "rk44"}}, "integrator.kind = 'rk44': unknown, did you mean `rk4`?"),
    }[kind]
    with pytest.raises(ValueError, match=r".") as caught:
        type(row.task)(**given)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pursuit(pursuer_sped=2), "did you mean `pursuer_speed`"),
        (lambda: Pursuit(pursuers=0), "pursuers = 0"),
        (lambda: Pursuit(sides="neither"), "sides = 'neither'"),
        (lambda: Obstacles(size=5), "size = 5"),
        (lambda: Obstacles(least_radius=2, greatest_radius=1), "least_radius = 2"),
        (lambda: Obstacles(greatest_radius=4), "greatest_radius = 4"),  # an obstacle could cover the start
        (lambda: Flock(least_radius=3, greatest_radius=1), "least_radius = 3"),
        (lambda: Flock(agents=0), "agents = 0"),
        (lambda: Flock(agents=10**9), "agents = 1000000000"),
        (lambda: Flock(agents=4, learners=5), "learners = 5"),
        (lambda: Flock(sight=25), "sight = 25"),
        (lambda: Flock(cruise=float("nan")), "cruise = nan"),
        (lambda: Flock(dt=0), "dt = 0"),
    ],
)
def test_invalid_parameters_of_a_task_are_refused_in_one_line(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


FROZEN = """
import importlib, pickle, sys
from collections import namedtuple
import numpy as np
from flockenv.tasks.decision import indices_of
from flockenv.tasks.task import Frame

for name, task, before, after, action, terms, observation, counted, measured in pickle.load(open(sys.argv[1], "rb")):
    module = importlib.import_module(type(task).__module__)
    assert not hasattr(module.reward, "py_func"), "the laws must run in Python here"
    numbers = task.parameters()
    p = namedtuple("P", numbers)(**numbers)
    for array in (*before, *after, action):
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    before, after = Frame(*before), Frame(*after)
    found, rows = np.full(terms.shape, np.nan), np.full(observation.shape, np.nan, np.float32)
    at = indices_of(task.measures)
    module.reward(p, indices_of(task.terms), before, after._replace(alive=before.alive), action, found)
    numbers = np.zeros(len(task.measures))
    module.ended(p, at, before, after._replace(alive=after.alive.copy()), numbers, np.zeros(len(terms), bool))
    module.measure(p, at, before, after, numbers)
    Measures, metrics = namedtuple("Measures", task.measures), np.full(len(task.metric_names), np.nan)
    for array in counted[:2]:
        array.flags.writeable = False
    module.metrics(p, indices_of(task.metric_names), Measures(*counted[0]), Measures(*counted[1]), counted[2], metrics)
    np.testing.assert_allclose(metrics, measured, rtol=1e-12, err_msg=name)
    slots = indices_of(*zip(*task.layout.places.items()))
    if task.abreast:
        module.abreast(p, slots, after, rows[:, : task.abreast])
    module.observe(p, slots, after, rows)
    np.testing.assert_allclose(found, terms, rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(rows, observation, atol=2e-6, err_msg=name)
print("untouched")
"""


def frame(world: World) -> list[Any]:
    """Return the numbers of a Frame of world 0, as its kernels see it, with copies of the arrays."""
    s, scene = world.state, world.task.scene
    arrays = [s.x[:, 0], s.v[:, 0], s.alive[0], s.obstacle_x[:, 0], s.obstacle_radius[0], world._memory[:, 0]]
    body = [scene.body.radius, scene.body.max_speed, scene.body.max_force]
    decision, found, _ = world._scratch[0]  # those of the last world that was observed
    near, d = [*found[:-1], *[np.zeros(0)] * 3], scene.dimension
    if world.task.abreast:
        own, near_vel, near_radius = decision.padded[:3]
        arrays[:2], arrays[5], body[0] = (own[:d], own[d : 2 * d]), own[2 * d + 1 :], own[2 * d]
        near[-3:] = found.pos, near_vel, near_radius[0]
    table = np.array(world.task.table())
    return [*(a.copy() for a in arrays), int(s.key[0]), int(world.steps[0]), *body, *(a.copy() for a in near), table]


def test_kernels_of_a_task_do_not_write_to_frames(tmp_path: Path) -> None:
    """In plain Python, with all arrays of both frames read-only, they return what the compiled kernels return.

    `ended` may write `alive`, and nothing else of a frame. Numpy refuses to write metrics beyond their number.
    """
    cases = []
    for row in ROWS:
        world = world_of(row.task)
        for actions in random_actions(world, 30):
            before = frame(world)
            step = world.step(actions)
            counted = world._sums[0].copy(), world._last[0].copy(), int(world.steps[0])
            measured = [float(column[0]) for column in world.measure().values()]
            seen = (actions[0], step.terms[0], step.observation[0])
            case = (row.name, row.task, before, frame(world), *seen, counted, measured)
        cases.append(case)
    (tmp_path / "frames").write_bytes(pickle.dumps(cases))
    source = str(Path(flockenv.__file__).parent.parent)
    done = subprocess.run(
        [sys.executable, "-c", FROZEN, str(tmp_path / "frames")],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": source},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "untouched\n", done.stderr


@EVERY
def test_observing_changes_nothing(row: TaskRow) -> None:
    world = world_of(row.task, worlds=3)
    for actions in random_actions(world, 20):
        step = world.step(actions)
    kept, memory = world.state.copy(), world._memory.copy()
    again = world.reset(mask=np.zeros(3, bool))  # no world is reset: all are only observed
    world.measure()
    world.snapshot(1)
    np.testing.assert_array_equal(again, step.observation)
    for name in ("x", "v", "alive", "tick", "obstacle_x", "obstacle_radius"):
        np.testing.assert_array_equal(getattr(world.state, name), getattr(kept, name))
    np.testing.assert_array_equal(world._memory, memory)


# --- Pursuit ----------------------------------------------------------------------------------------------------------


def test_a_capture_pays_once_and_ends_the_episode() -> None:
    world = world_of(Pursuit())
    place(world, [[10, 10], [10.4, 10]])
    step = act(world)
    assert paid(world, step)["capture"] == 10
    assert step.terminated.all()
    assert step.success.all()
    assert step.ended.all()
    assert not step.truncated.any()
    assert world.measure()["captured"] == 1
    after = act(world)
    assert paid(world, after)["capture"] == 0
    assert after.terminated.all()


def test_no_capture_beyond_the_capture_distance() -> None:
    world = world_of(Pursuit())
    place(world, [[10, 10], [10.61, 10]])
    step = act(world)  # the evader runs
    assert paid(world, step)["capture"] == 0
    assert not step.terminated.any()
    assert not step.success.any()


def test_approaching_pays_per_metre_and_time_costs() -> None:
    world = world_of(Pursuit())
    place(world, [[10, 10], [13, 10]], [[3, 0], [0, 0]])
    step = act(world, [1, 0])
    distance = np.linalg.norm(world.state.pos[0, 1] - world.state.pos[0, 0])
    terms = paid(world, step)
    assert terms["closing"] == pytest.approx(0.1 * (3 - distance), rel=1e-9)
    assert terms["closing"] > 0.015  # 0.3 m at full speed, less the distance that the evader moves
    assert terms["time"] == pytest.approx(-0.5 * 0.1)
    assert terms["capture"] == 0


@pytest.mark.parametrize("steps", [1, 4])
def test_time_to_capture_counts_every_step_up_to_the_capture(steps: int) -> None:
    world = world_of(Pursuit())
    place(world, [[3, 3], [17, 17]])
    for _ in range(steps - 1):
        act(world)
        assert world.measure()["captured"] == 0
    place(world, [[10, 10], [10.3, 10]])
    assert act(world).success.all()
    assert world.measure()["time_to_capture"] == pytest.approx(steps * 0.1)
    act(world)
    assert world.measure()["time_to_capture"] == pytest.approx(steps * 0.1)


def test_the_scripted_evader_flees_within_its_alarm_distance() -> None:
    for distance in (2.5, 4, 7):
        for turn in np.linspace(0, 2 * np.pi, 7)[:-1]:
            ahead = np.array([np.cos(turn), np.sin(turn)])
            world = world_of(Pursuit(size=60))
            place(world, [30 - distance / 2 * ahead, 30 + distance / 2 * ahead], [3 * ahead, 0 * ahead])
            for _ in range(5):
                act(world, ahead)
            assert world.state.vel[0, 1] @ ahead > 0.8  # it can reach 2.4 m/s in 0.2 s, and may swerve


def test_the_scripted_evader_wanders_beyond_its_alarm_distance() -> None:
    world = world_of(Pursuit(size=60, alarm_distance=5))
    place(world, [[5, 5], [40, 40]])
    courses = []
    for _ in range(60):
        act(world)
        courses.append(np.arctan2(*world.state.vel[0, 1]))
    turned = np.abs(np.diff(np.unwrap(courses[5:])))
    assert np.linalg.norm(world.state.vel[0, 1]) > 2
    assert 0.01 < turned.mean() < 0.5
    other = world_of(Pursuit(size=60, alarm_distance=5), seed=4)
    place(other, [[5, 5], [40, 40]])
    for _ in range(60):
        act(other)
    assert not np.allclose(other.state.vel[0, 1], world.state.vel[0, 1])


def test_the_scripted_evader_stays_off_the_walls_and_within_its_speed() -> None:
    world = world_of(Pursuit(), worlds=16)
    fastest, off = 0.0, []
    for actions in random_actions(world, 400):
        world.step(actions)
        evader = world.state.pos[:, 1]
        off.append(np.minimum(evader, 20 - evader).min(axis=1))
        fastest = max(fastest, np.linalg.norm(world.state.vel[:, 1], axis=1).max())
    assert 2.39 < fastest <= 2.4 * (1 + 1e-12)
    assert np.mean(np.array(off) > 0.5) > 0.95


def both(**more: Any) -> World:
    return world_of(Pursuit(pursuers=3, evaders=2, sides="both", **more))


def test_with_two_sides_a_captured_evader_is_removed() -> None:
    world = both()
    place(world, [[3, 3], [3, 10], [3, 17], [17, 3], [17, 17]])
    act(world)
    place(world, [[3, 3], [3, 10], [3, 17], [3.2, 3], [17, 17]])
    first = act(world)
    np.testing.assert_array_equal(first.terminated[0], [False, False, False, True, False])
    np.testing.assert_array_equal(first.alive[0], [True, True, True, False, True])
    np.testing.assert_array_equal(first.terms[0, :, 1], [10, 10, 10, -10, 0])
    assert not first.success.any()
    assert not first.ended.any()
    later = act(world)
    np.testing.assert_array_equal(later.terminated[0], [False, False, False, True, False])
    np.testing.assert_array_equal(later.terms[0, :, 1], 0)
    np.testing.assert_array_equal(later.terms[0, 3], 0)  # a captured evader gets no reward
    assert world.measure()["captured"] == 1
    place(world, [[3, 3], [3, 10], [3, 17], [3.2, 3], [3.2, 17]])
    last = act(world)
    assert last.terminated.all()
    assert last.success.all()
    assert last.ended.all()
    np.testing.assert_array_equal(last.terms[0, :, 1], [10, 10, 10, 0, -10])
    assert world.measure()["captured"] == 2


def test_evaders_are_paid_the_opposite() -> None:
    world = world_of(Pursuit(sides="both"))
    place(world, [[10, 10], [13, 10]], [[3, 0], [0, 0]])
    step = world.step(np.full((1, 2, 2), [[[0.3, 0.4]]]))
    np.testing.assert_allclose(step.terms[0, 0], -step.terms[0, 1])
    assert step.terms[0, 0, 0] > 0


def test_a_dead_evader_is_not_seen() -> None:
    world = both()
    place(world, [[3, 3], [3, 10], [3, 17], [3.2, 3], [17, 17]])
    seen = world.task.layout.unpack(act(world).observation)
    np.testing.assert_array_equal(seen.opponent_present[0, :3].sum(axis=-1), 1)
    offset = world.state.pos[0, 4] - world.state.pos[0, 0]
    np.testing.assert_allclose(seen.opponents[0, 0, 0], offset, atol=1e-5)


def test_pursuit_observations_are_the_offsets_and_velocities_of_others() -> None:
    world = both()
    for actions in random_actions(world, 25):
        step = world.step(actions)
    seen, s = world.task.layout.unpack(step.observation), world.state
    for i in range(5):
        x, v = s.pos[0], s.vel[0]
        others, mates = ([3, 4], [0, 1, 2]) if i < 3 else ([0, 1, 2], [3, 4])
        others = sorted(others, key=lambda j: np.linalg.norm(x[j] - x[i]))
        mates = sorted((j for j in mates if j != i), key=lambda j: np.linalg.norm(x[j] - x[i]))
        np.testing.assert_allclose(seen.velocity[0, i], v[i], atol=1e-5)
        np.testing.assert_allclose(seen.to_low[0, i], x[i], atol=1e-5)
        np.testing.assert_allclose(seen.to_high[0, i], 20 - x[i], atol=1e-5)
        np.testing.assert_allclose(seen.opponents[0, i, : len(others)], x[others] - x[i], atol=1e-5)
        np.testing.assert_allclose(seen.opponent_velocity[0, i, : len(others)], v[others], atol=1e-5)
        np.testing.assert_allclose(seen.mates[0, i, : len(mates)], x[mates] - x[i], atol=1e-5)
        assert seen.opponent_present[0, i].sum() == len(others)
        assert seen.mate_present[0, i].sum() == len(mates)
        np.testing.assert_array_equal(seen.opponents[0, i, len(others) :], 0)


def test_pursuit_begins_apart_and_at_rest() -> None:
    world = world_of(Pursuit(), worlds=200)
    assert np.linalg.norm(world.state.pos[:, 1] - world.state.pos[:, 0], axis=1).min() >= 4
    np.testing.assert_array_equal(world.state.vel, 0)


# --- Obstacles --------------------------------------------------------------------------------------------------------


def goal_of(world: World) -> Any:
    (mark,) = [m for m in world.snapshot().marks if m.kind == "goal"]
    return mark.at


def test_a_touch_costs_and_ends_the_episode() -> None:
    world = world_of(Obstacles())
    s = world.state
    centre, radius = s.obstacles.centre[0, 0], s.obstacle_radius[0, 0]
    place(world, centre + np.array([0, radius + 0.29]))
    step = act(world)
    assert paid(world, step)["touch"] == -10
    assert paid(world, step)["goal"] == 0
    assert step.terminated.all()
    assert not step.success.any()
    assert world.measure()["collisions"] == 1


def test_a_small_gap_to_an_obstacle_is_no_touch() -> None:
    world = world_of(Obstacles(count=1))
    s = world.state
    place(world, s.obstacles.centre[0, 0] + [s.obstacle_radius[0, 0] + 0.31, 0])
    step = act(world)
    assert paid(world, step)["touch"] == 0
    assert not step.terminated.any()


def test_the_goal_pays_and_ends_the_episode() -> None:
    world = world_of(Obstacles())
    place(world, goal_of(world) + np.array([-0.9, 0]), [2.0, 0])
    step = act(world)
    terms = paid(world, step)
    assert terms["goal"] == 10
    assert terms["progress"] == pytest.approx(0.5 * 0.2)
    assert terms["time"] == pytest.approx(-0.5 * 0.1)
    assert step.terminated.all()
    assert step.success.all()


def test_progress_adds_up_to_the_distance_gained() -> None:
    world = world_of(Obstacles(count=0))
    goal, start = goal_of(world), world.state.pos[0, 0].copy()
    total = sum(paid(world, act(world, actions[0]))["progress"] for actions in random_actions(world, 50))
    gained = np.linalg.norm(goal - start) - np.linalg.norm(goal - world.state.pos[0, 0])
    assert total == pytest.approx(0.5 * gained, abs=1e-9)


def test_a_goal_in_an_obstacle_is_a_touch() -> None:
    world = world_of(Obstacles(count=1))
    world.state.obstacles.centre[0, 0] = goal_of(world)
    place(world, goal_of(world))
    step = act(world)
    assert paid(world, step)["goal"] == 0
    assert paid(world, step)["touch"] == -10
    assert not step.success.any()


def test_a_wall_stops_the_agent_and_is_no_touch() -> None:
    world = world_of(Obstacles(count=0))
    for _ in range(60):
        step = act(world, [-1, 0])
    assert not step.terminated.any()
    assert world.state.pos[0, 0, 0] == 0.3
    assert world.state.vel[0, 0, 0] == 0


def test_a_straight_path_is_fully_efficient() -> None:
    world = world_of(Obstacles(count=0))
    place(world, [1.5, goal_of(world)[1]])
    world._memory[2, 0, 0] = goal_of(world)[0] - 1.5
    while not (step := act(world, [1, 0])).success.any():
        assert not step.ended.any()
    measured = world.measure()
    assert measured["path_efficiency"] == pytest.approx(1, rel=1e-9)
    assert measured["time_to_goal"] == pytest.approx(world.steps[0] * 0.1)


def test_obstacle_observations_are_goal_velocity_obstacles_and_free_distances() -> None:
    world = world_of(Obstacles())
    for actions in random_actions(world, 12):
        step = world.step(actions)
    seen, s, task = world.task.layout.unpack(step.observation[0, 0]), world.state, world.task
    x, centres, radii = s.pos[0, 0], s.obstacles.centre[0], s.obstacle_radius[0]
    np.testing.assert_allclose(seen.goal, goal_of(world) - x, atol=1e-5)
    np.testing.assert_allclose(seen.velocity, s.vel[0, 0], atol=1e-5)
    gap = np.linalg.norm(centres - x, axis=1) - radii
    gap[radii == 0] = np.inf
    order = np.argsort(gap)[: task.slots]  # type: ignore[attr-defined]
    order = order[gap[order] < task.sight]  # type: ignore[attr-defined]
    n = len(order)
    assert n > 0
    np.testing.assert_allclose(seen.obstacles[:n], (centres - x)[order], atol=1e-5)
    np.testing.assert_allclose(seen.obstacle_radius[:n], radii[order], atol=1e-5)
    np.testing.assert_array_equal(seen.obstacle_radius[n:], 0)
    turns = 2 * np.pi * np.arange(len(seen.free_way)) / len(seen.free_way)
    steps = np.arange(0, task.sight, 0.01)  # type: ignore[attr-defined]
    points = x + steps[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    blocked = (np.linalg.norm(points[:, :, None] - centres, axis=3) < radii + 0.3 * (radii > 0)).any(axis=2)
    expected = np.where(blocked.any(axis=0), steps[blocked.argmax(axis=0)], task.sight)  # type: ignore[attr-defined]
    assert blocked.any()
    np.testing.assert_allclose(seen.free_way, expected, atol=0.011)


def test_obstacles_leave_gaps_and_do_not_cover_start_and_goal() -> None:
    world = world_of(Obstacles(), worlds=100)
    s = world.state
    assert (s.obstacle_radius > 0).sum(axis=1).min() > 10
    for b in range(100):
        there = s.obstacle_radius[b] > 0
        centre, radius = s.obstacles.centre[b][there], s.obstacle_radius[b][there]
        for point in (s.pos[b, 0], world._memory[:2, b, 0]):
            assert (np.linalg.norm(centre - point, axis=1) - radius).min() > 0.3
        gaps = np.linalg.norm(centre[:, None] - centre, axis=2) - radius[:, None] - radius + 1e9 * np.eye(len(centre))
        assert gaps.min() >= 1.0 - 1e-12


# --- Flock ------------------------------------------------------------------------------------------------------------


def pair(gap: float, first: Any, second: Any, **more: Any) -> tuple[World, dict[str, float], dict[str, float]]:
    """Step two boids once, 0.1 s, without action, to `gap` m apart along the heading; return world and reward terms.

    first, second: velocities (along the heading, to its left), m/s.
    """
    world = world_of(Flock(agents=2, obstacle_count=0, **more))
    (mark,) = world.snapshot().marks
    along = mark.vector / np.linalg.norm(mark.vector)
    axes = np.array([along, [-along[1], along[0]]])
    velocities = np.array([first, second], float) @ axes
    ends = np.array([20.0, 20.0]) + np.array([[0.0], [gap]]) * along
    place(world, ends - 0.1 * velocities, velocities)
    step = act(world)
    return world, paid(world, step, 0), paid(world, step, 1)


def test_rewards_of_two_aligned_boids_match_the_formulas() -> None:
    """At cruising speed along the heading, 1.5 m apart: they lose reward only for four missing neighbours."""
    world, a, b = pair(1.5, (2, 0), (2, 0))
    for terms in (a, b):
        expected = [0.1, 0, 0, -0.5 * (1 - 1 / 6) * 0.1, 0, 0]
        np.testing.assert_allclose([terms[name] for name in Flock.terms], expected, atol=1e-9)
    measured = world.measure()
    assert measured["polarisation"] == pytest.approx(1)
    assert measured["nearest_neighbour"] == pytest.approx(1.5)
    assert measured["speed_along"] == pytest.approx(2)
    assert measured["collisions"] == 0


def test_rewards_of_two_unaligned_boids_match_the_formulas() -> None:
    """One is at rest, the other, 2 m away, flies across at 1 m/s."""
    world, a, b = pair(2.0, (0, 0), (0, 1))
    assert a["progress"] == b["progress"] == pytest.approx(0)  # 2 m/s short of 2 m/s
    assert a["alignment"] == b["alignment"] == pytest.approx(-0.5 * (1 / 2) * 0.1)
    assert a["spacing"] == b["spacing"] == pytest.approx(-0.5 * (0.5 / 1.5) * 0.1)
    assert a["touch"] == b["touch"] == 0
    assert world.measure()["speed_along"] == pytest.approx(0)


def test_a_touch_costs_as_long_as_it_lasts_and_counts_once() -> None:
    world, a, b = pair(0.5, (1, 0), (1, 0))
    assert a["touch"] == b["touch"] == pytest.approx(-10 * 0.1)
    assert a["spacing"] == pytest.approx(-0.5 * (1.0 / 1.5) * 0.1)
    assert a["progress"] == pytest.approx(0.5 * 0.1)
    touching = world.measure()["collisions"]
    assert paid(world, act(world))["touch"] == pytest.approx(-10 * 0.1)
    assert world.measure()["collisions"] == touching  # the same touch goes on


def test_polarisation_is_the_length_of_the_mean_heading() -> None:
    world, _, _ = pair(3.0, (2, 0), (0, 0.5))
    assert world.measure()["polarisation"] == pytest.approx(np.sqrt(0.5))


def test_an_isolated_boid_pays_for_missing_neighbours() -> None:
    _, a, _ = pair(15.0, (2, 0), (2, 0))
    assert a["together"] == pytest.approx(-0.5 * 0.1)
    assert a["alignment"] == pytest.approx(-0.5 * 0.1)


def test_an_absent_boid_is_not_seen_and_its_touch_costs_nothing() -> None:
    """The neighbour lists of the decision before, in which it touched, are not used again."""
    world, a, b = pair(0.5, (1, 0), (1, 0))
    assert a["touch"] == b["touch"] < 0
    world.state.alive[0, 1] = False
    step = act(world)
    for learner in (0, 1):
        assert paid(world, step, learner)["touch"] == 0
        assert paid(world, step, learner)["together"] == pytest.approx(-0.5 * 0.1)
    assert not world.task.layout.unpack(step.observation).neighbour_present.any()


def test_observations_do_not_depend_on_the_number_of_learners() -> None:
    """Rows are computed in squares of sixteen; only those of existing learners are written."""
    whole = World(Flock(agents=24), 2).reset(5)
    for learners in (1, 15, 16, 17, 23):
        part = World(Flock(agents=24, learners=learners), 2).reset(5)
        np.testing.assert_array_equal(part, whole[:, :learners])


def test_a_boid_in_an_obstacle_pays() -> None:
    world = world_of(Flock(agents=2, obstacle_count=1))
    s = world.state
    place(world, s.obstacles.centre[0, 0] + [[s.obstacle_radius[0, 0] + 0.2, 0], [9, 9]])
    step = act(world)
    assert paid(world, step, 0)["obstacle"] == pytest.approx(-10 * 0.1)
    assert paid(world, step, 1)["obstacle"] == 0
    assert not step.terminated.any()


def test_neighbours_are_found_across_the_edge() -> None:
    world = world_of(Flock(agents=2, obstacle_count=0))
    place(world, [[39.5, 20], [0.5, 20]])
    step = act(world)
    assert paid(world, step)["together"] == pytest.approx(-0.5 * (1 - 1 / 6) * 0.1)
    seen = world.task.layout.unpack(step.observation)
    assert np.linalg.norm(seen.neighbours[0, 0, 0]) == pytest.approx(1.0, rel=1e-5)


def test_flock_observations_are_in_the_frame_of_the_heading() -> None:
    world = world_of(Flock())
    for actions in random_actions(world, 15):
        step = world.step(actions)
    seen, s, task = world.task.layout.unpack(step.observation[0]), world.state, world.task
    (mark,) = world.snapshot().marks
    along = mark.vector / np.linalg.norm(mark.vector)
    axes = np.array([along, [-along[1], along[0]]]).T
    for i in range(24):
        offset = task.scene.space.displacement(s.pos[0, i], s.pos[0])
        distance = np.linalg.norm(offset, axis=1)
        distance[i] = np.inf
        order = np.argsort(distance)[: task.neighbours]  # type: ignore[attr-defined]
        order = order[distance[order] < task.sight]  # type: ignore[attr-defined]
        n = len(order)
        np.testing.assert_allclose(seen.velocity[i], s.vel[0, i] @ axes, atol=1e-5)
        np.testing.assert_allclose(seen.neighbours[i, :n], offset[order] @ axes, atol=1e-5)
        relative = (s.vel[0, order] - s.vel[0, i]) @ axes
        np.testing.assert_allclose(seen.neighbour_velocity[i, :n], relative, atol=1e-5)
        np.testing.assert_array_equal(seen.neighbour_present[i], [1] * n + [0] * (task.neighbours - n))  # type: ignore[attr-defined]


def test_observations_and_rewards_of_a_flock_do_not_change_by_a_quarter_turn() -> None:
    """Field, obstacles and heading are turned about the middle: no number may depend on absolute directions."""
    world = world_of(Flock(), worlds=2)
    for actions in random_actions(world, 10):
        world.step(actions)
    turned, s = world_of(Flock(), worlds=2), world.state
    middle, quarter = 20.0, np.array([[0.0, -1.0], [1.0, 0.0]])
    t = turned.state
    for theirs, ours in ((s.pos, t.pos), (s.obstacles.centre, t.obstacles.centre)):
        ours[...] = (theirs - middle) @ quarter.T + middle
    t.vel[...], t.obstacle_radius[...] = s.vel @ quarter.T, s.obstacle_radius
    turned._memory[...] = np.einsum("ij,jbn->ibn", quarter, world._memory)
    nothing = np.zeros(2, bool)
    np.testing.assert_allclose(turned.reset(mask=nothing), world.reset(mask=nothing), atol=1e-6)
    for actions in random_actions(world, 20, seed=1):
        ours, theirs = turned.step(actions), world.step(actions)
        np.testing.assert_allclose(ours.observation, theirs.observation, atol=1e-5)
        np.testing.assert_allclose(ours.terms, theirs.terms, atol=1e-6)


def test_scripted_flockmates_flock() -> None:
    """The learner does nothing; the others form a flock and fly along the heading."""
    world = world_of(Flock(learners=1), worlds=4)
    for _ in range(250):
        world.step(np.zeros((4, 1, 2)))
    v = world.state.vel[:, 1:]
    heading = world._memory[:2, :, 0].T
    along = (v * heading[:, None]).sum(axis=2)
    assert along.mean() > 1.4
    polarisation = np.linalg.norm((v / np.linalg.norm(v, axis=2, keepdims=True)).mean(axis=1), axis=1)
    assert polarisation.mean() > 0.8


@pytest.mark.parametrize("dtype", [pytest.param("float32", marks=pytest.mark.slow), "float64"])
@pytest.mark.parametrize("agents", [pytest.param(1, marks=pytest.mark.slow), 17, 33])
def test_numbers_beyond_the_last_agent_make_no_difference(agents: int, dtype: str) -> None:
    """Arrays are padded to whole blocks of agents; numbers in the padding make no difference."""
    results = []
    for beyond in (0.0, np.nan):
        world = world_of(Flock(agents=agents, dtype=dtype, settling=0.0), worlds=3)
        own, *near = world._scratch[0][0].padded[:3]
        near.append(world._scratch[0][1].pos)
        found = []
        for actions in random_actions(world, 5):
            for numbers in (own, *near):
                numbers[..., agents:] = beyond
            step = world.step(actions)
            found += [step.observation, step.terms, step.success, *(world.measure().values())]
        assert np.isnan(own[:, agents:]).all() == np.isnan(beyond) or agents % PAIR == 0
        results.append(found)
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.isfinite(one).all()


class Seen(NamedTuple):
    """The part of a frame that a scripted flockmate reads to find its neighbours."""

    pos: Any
    alive: Any


class Numbers(NamedTuple):
    """The part of a task's parameters that it reads."""

    neighbours: float
    sight: float
    size: float


@njit
def listed(p: Numbers, frame: Seen, i: int, squares: Any, indices: Any) -> Any:
    """Call `_list_nearest` as a kernel does."""
    return flock._list_nearest(p, frame, i, squares, indices)


@pytest.mark.parametrize("neighbours", [1, 2, 6, 32])
@pytest.mark.parametrize("agents", [1, 2, 7, 60])
def test_a_scripted_flockmate_lists_its_nearest_neighbours(agents: int, neighbours: int) -> None:
    """On a lattice, where many are equally far: these come in the order of their numbers. Also across the edge."""
    rng = np.random.default_rng(agents)
    frame = Seen(rng.integers(0, 8, (2, agents)) * 1.0, rng.random(agents) < 0.8)
    for i in range(agents):
        offset = (frame.pos - frame.pos[:, i, None] + 4) % 8 - 4
        square = (offset**2).sum(axis=0)
        square[~frame.alive | (np.arange(agents) == i) | (square >= 9.0)] = np.inf
        expected = [j for j in np.argsort(square, kind="stable") if square[j] < np.inf][:neighbours]
        squares, indices = np.full(32, np.inf), np.zeros(32, np.uint64)
        found = int(listed(Numbers(float(neighbours), 3.0, 8.0), frame, i, squares, indices))
        assert indices[:found].tolist() == expected
        assert squares[:found].tolist() == square[expected].tolist()


def test_a_flock_begins_without_touches() -> None:
    world = world_of(Flock(), worlds=50)
    s, space = world.state, world.task.scene.space
    for b in range(50):
        gaps = np.linalg.norm(space.displacement(s.pos[b, :, None], s.pos[b, None]), axis=2) + 1e9 * np.eye(24)
        assert gaps.min() > 0.6
        there = s.obstacle_radius[b] > 0
        offset = space.displacement(s.pos[b, :, None], s.obstacles.centre[b, there][None])
        assert (np.linalg.norm(offset, axis=2) - s.obstacle_radius[b, there]).min() > 0.3
