"""Central critic: what it observes, and that the actor observes none of that."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import ppo
from agents.central_critic import CentralVecEnv
from agents.experiment import Experiment, PpoSettings
from agents.run import OtherRecipe, load_checkpoint
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.world import World
from flockenv.players.policy import MlpPolicy
from flockenv.tasks import Flock, Herd, School, Task
from tests.training import interrupt

SCHOOL = School(fish=3, hunters=1, patches=2, start_hunger=0.6, metabolism=0.8)  # fish starve one after another


def actions_for(task: Task, worlds: int, steps: int) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    rng = np.random.default_rng(4)
    return list(rng.uniform(-1, 1, (steps, worlds * task.learners, task.action_layout.size)))


def besides(world: World, seen: Any, b: int) -> list[float]:
    """Return the numbers that the critics of world b observe in addition to the rows of their learners."""
    first = world.learners
    here = [i for i in range(first) if world.state.alive[b, i]]
    shown = [sum(float(seen[b, i, k]) for i in here) / max(len(here), 1) for k in range(seen.shape[2])]
    shown += [len(here) / first, float(world.steps[b]) / 6]
    return shown + [float(row[j]) for row in world.memory[b] for j in range(first, world.agents)]


def test_rows_append_the_critic_s_observation_to_the_learner_s() -> None:
    """Equal to a single world's: of the next episode's start in the rows, and of the last end in the infos."""
    plain, central = (kind(SCHOOL, 3, time_limit=6, leaving=True) for kind in (WorldVecEnv, CentralVecEnv))
    lone, size, shares, ends = World(SCHOOL, 3, time_limit=6), SCHOOL.layout.size, set(), []
    for env in (plain, central):
        env.seed(5)
    lone.reset(5)
    assert central.observation_space.shape == (2 * size + 2 + 3 * SCHOOL.memory,)
    np.testing.assert_array_equal(central.reset()[:, :size], plain.reset())
    for world in (plain.world, central.world, lone):
        world.steps[:] = (0, 2, 3)
    for actions in actions_for(SCHOOL, 3, 14):
        rows, reward, done, infos = central.step(actions)
        expected_rows, paid, over, others = plain.step(actions)
        np.testing.assert_array_equal(rows[:, :size], expected_rows)
        np.testing.assert_array_equal(reward, paid)
        np.testing.assert_array_equal(done, over)
        step = lone.step(actions.reshape(3, 3, -1))
        seen = step.observation.copy()
        for row in range(9):
            b, i = divmod(row, 3)
            if done[row]:
                last = infos[row]["terminal_observation"]
                np.testing.assert_array_equal(last[:size], others[row]["terminal_observation"])
                np.testing.assert_allclose(last, [*seen[b, i].tolist(), *besides(lone, seen, b)], rtol=1e-6, atol=1e-6)
        ends.append(tuple(step.ended.tolist()))
        if step.ended.any():
            lone.reset(mask=step.ended, into=seen)
        for row in range(9):
            b, i = divmod(row, 3)
            expected = [*seen[b, i].tolist(), *besides(lone, seen, b)]
            shares.add(expected[2 * size])
            np.testing.assert_allclose(rows[row], expected, rtol=1e-6, atol=1e-6)
    assert any(any(which) and not all(which) for which in ends) and len(shares) > 2


@pytest.mark.parametrize("task", [Flock(agents=7), Herd(sheep=5, dogs=2)], ids=lambda task: task.name)
def test_rows_have_the_observation_space_with_one_and_several_learners(task: Task) -> None:
    central = CentralVecEnv(task, 2)
    rows = central.reset()
    assert rows.shape == (2 * task.learners, *central.observation_space.shape) and rows.dtype == np.float32
    assert np.isfinite(rows).all()


def settings(**changes: Any) -> Experiment:
    few = {"steps": 384, "worlds": 4, "rollout": 16, "minibatch": 64, "epochs": 1, "hidden": (8, 8), "threads": 1}
    few |= {"evaluate_every": 192, "evaluate_worlds": 4, "central_critic": True, "care": 1.0}
    arguments = {"fish": 3, "patches": 2, "horizon": 20}
    return Experiment(task="school", arguments=arguments, ppo=PpoSettings(**{**few, **changes}))


def test_actor_ignores_the_critic_s_observation_and_is_exported() -> None:
    experiment = settings()
    task = experiment.build()
    model = ppo.build(task, experiment.ppo)
    model.learn(192)
    rows = torch.as_tensor(model.env.reset())
    size, other = task.layout.size, rows.clone()
    other[:, size:] += 1.0
    with torch.no_grad():
        acts = [model.policy.get_distribution(some).mode().numpy() for some in (rows, other, rows[:, :size])]
        values = [model.policy.predict_values(some).numpy() for some in (rows, other)]
    np.testing.assert_array_equal(acts[0], acts[1])
    np.testing.assert_allclose(acts[0], acts[2], rtol=1e-6)
    assert (values[0] != values[1]).all()
    alone = MlpPolicy(ppo.tensors_of(model), {"activation": "relu"})
    answers, _ = alone.predict(rows[:, :size].numpy(), deterministic=True)
    np.testing.assert_allclose(answers, np.clip(acts[0], -1, 1), rtol=1e-5, atol=1e-6)


def test_training_with_a_central_critic_and_held_actions_can_be_resumed(tmp_path: Path) -> None:
    """The count of steps continues, networks are restored, and still only the critic learns."""
    update = 4 * 3 * 16 * 3
    changes = {"taught": 3, "critic_first": 4 * update, "hold": 3, "steps": 3 * update, "evaluate_every": update}
    experiment = settings(**changes)
    interrupt(experiment, tmp_path)
    begun = load_checkpoint(experiment, tmp_path)
    assert begun is not None and begun.steps == update
    kept = begun.state["policy"]
    run = ppo.train(experiment, tmp_path, go_on=True)
    assert [point["steps"] for point in run.curve] == [update, 2 * update, 3 * update, 3 * update]
    found = run.state["policy"]
    for name in ("action_net.weight", "mlp_extractor.policy_net.0.weight", "log_std"):
        np.testing.assert_array_equal(found[name], kept[name])
    assert not np.array_equal(found["value_net.weight"], kept["value_net.weight"])
    thawed = ppo.train(settings(**{**changes, "critic_first": update}), tmp_path / "other")
    assert thawed.steps == 3 * update
    assert not np.array_equal(thawed.state["policy"]["action_net.weight"], kept["action_net.weight"])
    with pytest.raises(OtherRecipe, match=r"central_critic = False: the checkpoint in .* with True"):
        ppo.train(settings(**changes, central_critic=False), tmp_path, go_on=True)
