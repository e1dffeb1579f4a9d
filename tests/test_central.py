"""A critic that sees more than its actor: what it is shown, and that the actor is shown none of it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import ppo
from agents.central import CentralVecEnv
from agents.experiment import Experiment, PpoSettings
from flockenv.policy import MlpPolicy
from flockenv.sb3 import WorldVecEnv
from flockenv.tasks import Flock, Herd, School, Task
from flockenv.world import World

SCHOOL = School(fish=3, hunters=1, patches=2, start_hunger=0.6, metabolism=0.8)  # fish starve one after another


def actions_for(task: Task, worlds: int, steps: int) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    rng = np.random.default_rng(4)
    return list(rng.uniform(-1, 1, (steps, worlds * task.learners, task.action_layout.size)))


def besides(world: World, seen: Any, b: int) -> list[float]:
    """What the critics of world b are shown beside their rows, number by number."""
    first = world.learners
    here = [i for i in range(first) if world.state.alive[b, i]]
    shown = [sum(float(seen[b, i, k]) for i in here) / max(len(here), 1) for k in range(seen.shape[2])]
    shown += [len(here) / first, float(world.steps[b]) / 6]
    return shown + [float(row[j]) for row in world.memory[b] for j in range(first, world.agents)]


def test_behind_what_a_learner_sees_stands_what_only_its_critic_is_shown() -> None:
    plain, central = (kind(SCHOOL, 2, time_limit=6, leaving=True) for kind in (WorldVecEnv, CentralVecEnv))
    lone, size, ended, left = World(SCHOOL, 2, time_limit=6), SCHOOL.layout.size, False, set()
    for env in (plain, central):
        env.seed(5)
    lone.reset(5)
    assert central.observation_space.shape == (2 * size + 2 + 3 * SCHOOL.memory,)
    np.testing.assert_array_equal(central.reset()[:, :size], plain.reset())
    for actions in actions_for(SCHOOL, 2, 9):
        rows, reward, done, infos = central.step(actions)
        told, paid, over, others = plain.step(actions)
        np.testing.assert_array_equal(rows[:, :size], told)
        np.testing.assert_array_equal(reward, paid)
        np.testing.assert_array_equal(done, over)
        step = lone.step(actions.reshape(2, 3, -1))
        last = [info.get("terminal_observation") for info in infos]
        for row in range(6):
            b, i = divmod(row, 3)
            here = rows[row] if last[row] is None else last[row]  # as its world ended, not as the next one begins
            if not ended:
                expected = [*step.observation[b, i].tolist(), *besides(lone, step.observation, b)]
                left.add(expected[2 * size])
                np.testing.assert_allclose(here, expected, rtol=1e-6, atol=1e-6)
            if last[row] is not None:
                np.testing.assert_array_equal(here[:size], others[row]["terminal_observation"])
        ended |= any(info is not None for info in last)
    assert ended and len(left) > 2  # shares of fish that were there


@pytest.mark.parametrize("task", [Flock(agents=4), Herd(sheep=5, dogs=2)], ids=lambda task: task.name)
def test_whoever_learns_alone_or_with_others_has_a_critic(task: Task) -> None:
    central = CentralVecEnv(task, 2)
    rows = central.reset()
    assert rows.shape == (2 * task.learners, *central.observation_space.shape) and rows.dtype == np.float32
    assert np.isfinite(rows).all()


def settings(**changes: Any) -> Experiment:
    few = {"steps": 384, "worlds": 4, "rollout": 16, "minibatch": 64, "epochs": 1, "hidden": (8, 8), "threads": 1}
    few |= {"evaluate_every": 192, "evaluate_worlds": 4, "central_critic": True, "care": 1.0}
    arguments = {"fish": 3, "patches": 2, "horizon": 20}
    return Experiment(task="school", arguments=arguments, ppo=PpoSettings(**{**few, **changes}))


def test_an_actor_is_blind_to_what_its_critic_sees_and_is_what_is_exported() -> None:
    experiment = settings()
    task = experiment.build()
    model = ppo.build(task, experiment.ppo, None)
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


def test_a_central_critic_trains_is_taught_and_goes_on(tmp_path: Path) -> None:
    experiment = settings(taught=3, critic_first=64)
    whole = ppo.train(experiment, tmp_path)
    assert [point["steps"] for point in whole.curve] == [192, 384, 384]
    assert ppo.train(experiment, tmp_path, go_on=True).curve == whole.curve  # it is finished
    with pytest.raises(ppo.OtherRecipe, match=r"central_critic = False: the checkpoint in .* with True"):
        ppo.train(settings(taught=3, critic_first=64, central_critic=False), tmp_path, go_on=True)
