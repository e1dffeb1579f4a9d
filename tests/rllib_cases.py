"""Cases for agents.rllib: `python -m tests.rllib_cases NAME` in an environment with RLlib, see tests/test_rllib.py.

Each case is a function, runs in an empty folder, and raises an error if it fails.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from typer.testing import CliRunner

from agents import compare, rllib
from agents.experiment import CONFIGS, load_experiment
from agents.rllib_envs import RowsEnv
from agents.run import Run, load_checkpoint
from flockenv.envs.vector import CrossingVectorEnv
from flockenv.players.policy import MlpPolicy
from flockenv.studies.play_jobs import players_in_order
from flockenv.tasks import Crossing, Herd, Pursuit

SMALL = """
task: {task}
ppo: {{steps: {steps}, worlds: 16, rollout: 32, minibatch: 256, epochs: 2, log_std: -0.7, reward_scale: 0.3, threads: 1,
  evaluate_every: 2000, evaluate_worlds: 8, hidden: [32, 16], activation: tanh}}
"""


def small(task: str = "pursuit", steps: int = 4000) -> str:
    """Write a config of a short training; return its path."""
    Path(f"{task}.yaml").write_text(SMALL.format(task=task, steps=steps))
    return f"{task}.yaml"


def command(*arguments: str) -> tuple[int, str]:
    """Return the exit code of agents.rllib, and its output."""
    result = CliRunner().invoke(rllib.app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def read(path: str) -> dict[str, Any]:
    """Return the content of a JSON file."""
    content: dict[str, Any] = json.loads(Path(path).read_text())
    return content


def rows_are_those_of_the_native_environment() -> None:
    """Rewards are scaled, worlds of runners differ, and staggered worlds end their first episodes one by one."""
    task, rng = Crossing(agents=3, horizon=20), np.random.default_rng(0)
    settings: Any = {
        "task": "crossing", "arguments": {"agents": 3, "horizon": 20}, "disturbance": {"delay": 1}, "threads": 1,
        "first": 500, "seed": 7,
        "worlds": 4, "stagger": False, "reward_scale": 0.5, "num_envs": 12,
    }  # fmt: skip
    own, native = RowsEnv(settings), CrossingVectorEnv(12, max_episode_steps=20, agents=3, learners=3, delay=1)
    assert np.array_equal(own.reset(seed=7 + 2)[0], native.reset(seed=500 + 2 * 4)[0])
    assert not np.array_equal(own.reset(seed=7 + 1)[0], native.reset(seed=500 + 2 * 4)[0])
    own.reset(seed=7), native.reset(seed=500)
    paid = np.zeros(12)
    for _ in range(25):
        actions = rng.uniform(-1, 1, (12, task.action_layout.size)).astype(np.float32)
        (seen, reward, *ends, info), (also, full, *same, _) = own.step(actions), native.step(actions)
        assert np.array_equal(seen, also) and np.allclose(reward, 0.5 * full) and info == {}
        paid += np.abs(full)
        assert all(map(np.array_equal, ends, same))
    assert (paid > 0).all()
    staggered = RowsEnv({**settings, "stagger": True})
    staggered.reset(seed=7)
    ended = [staggered.step(0 * actions)[3].reshape(4, 3)[:, 0] for _ in range(20)]
    assert [int(np.argmax([end[k] for end in ended])) for k in range(4)] == [19, 14, 9, 4]


def settings_without_an_equal_are_refused_in_one_line() -> None:
    """Nothing is written then, and --plain trains without them."""
    config = small()
    for text, arguments in {
        "ppo.care = 1.0: must be 0.0 with RLlib; --plain trains with that": (str(CONFIGS / "bottleneck.yaml"),),
        "--team: obstacles has one learner; train it without --team": (str(CONFIGS / "obstacles.yaml"), "--team"),
        "school: its learners leave one by one; train it with --team": (str(CONFIGS / "school.yaml"), "--plain"),
        "--check 1: at least 2 episodes, and not with --team": (config, "--check", "1"),
        "--runners 3: must divide ppo.worlds = 16": (config, "--runners", "3"),
        "--networks agent: needs --team; without it all learners share one network": (config, "--networks", "agent"),
    }.items():
        code, output = command(*arguments)
        lines = [line for line in output.splitlines() if "WARNING" not in line]
        assert (code, lines) == (2, [f"error: {text}"]), output
    assert not Path("results").exists() and not list(Path().rglob("rllib-*"))
    plain = rllib.settings_of(load_experiment(CONFIGS / "bottleneck.yaml"), None, True, {})
    assert plain.ppo.care == 0 and plain.ppo.gamma == 0.98


def a_policy_trained_with_a_runner_plays_in_the_comparison() -> None:
    """It is better than random actions; its card has the recipe; a finished training is not trained again."""
    config, out = small(steps=30_000), "p.safetensors"
    code, output = command(config, "--out", out, "--runners", "1")
    assert code == 0, output
    card = read("p.json")
    assert (card["algorithm"], card["runners"], card["recipe"]["ppo"]["log_std"]) == ("PPO (RLlib)", 1, -0.7)
    assert 30_000 <= card["steps"] < 31_000 and len(card["curve"]) == 16
    with Path("runs/rllib/pursuit/log_1/progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(float(row["time/iterations"])) for row in rows] == list(range(1, len(rows) + 1)), "a row per iteration"
    assert [float(row["tuning/mean_return"]) for row in rows if row["tuning/mean_return"]] == [
        float(point["mean"]) for point in card["curve"]
    ]
    assert all(float(row["train/policy_loss"]) for row in rows)
    assert any(row["rollout/episode_return_mean"] for row in rows), "if an episode has ended"
    options = ["--tasks", "pursuit", "--players", f"random,{out}", "--worlds", "16", "--out", "compared"]
    result = CliRunner().invoke(compare.app, options)
    assert result.exit_code == 0, result.output
    players = read("compared/results.json")["tasks"]["pursuit"]["players"]
    assert players["p"]["mean_low"] > players["random"]["mean_high"], players
    before = Path(out).read_bytes()
    assert command(config, "--out", out)[0] == 0
    assert Path(out).read_bytes() == before and read("p.json")["curve"] == card["curve"]


def an_exported_policy_acts_as_in_rllib() -> None:
    """So it does behind all of RLlib's connectors, without noise and with it."""
    code, output = command(small(), "--out", "p.safetensors", "--check", "4")
    assert code == 0 and "RLlib's own evaluation" in output, output
    assert read("p.json")["rllib_evaluation"]["episodes"] == 4
    policy = MlpPolicy.load("p.safetensors", Pursuit())
    experiment = load_experiment("pursuit.yaml")
    run = load_checkpoint(experiment, Path("runs/rllib/pursuit"), state=())
    assert run is not None
    runner = SingleAgentEnvRunner(config=rllib.algorithm_config(experiment, None, 0))
    rllib._write_into(runner.module, run.tensors)
    for episode in runner.sample(num_timesteps=2000, explore=False):
        seen, acted = episode.get_observations()[:-1], np.clip(episode.get_actions(), -1, 1)
        assert np.abs(policy.predict(seen, deterministic=True)[0] - acted).max() < 1e-5
    rows = np.random.default_rng(0).uniform(-1, 1, (500, policy.observation_size)).astype(np.float32)
    with torch.no_grad():
        outputs = runner.module.forward_exploration({Columns.OBS: torch.from_numpy(rows)})
    mean, log_std = outputs[Columns.ACTION_DIST_INPUTS].numpy().reshape(500, 2, -1).swapaxes(0, 1)
    assert np.abs(policy.predict(rows, deterministic=True)[0] - np.clip(mean, -1, 1)).max() < 1e-5
    assert np.abs(policy._log_std - log_std).max() < 1e-6
    assert np.abs(run.tensors["log_std"] + 0.7).max() < 0.2 and np.any(run.tensors["log_std"] != -0.7)


def an_interrupted_training_continues() -> None:
    """Ctrl-C leaves a checkpoint from which the same command goes on, also with another number of runners."""
    config, folder = small(steps=20_000), Path("runs/rllib/pursuit")
    arguments = [sys.executable, "-m", "agents.rllib", config, "--out", "p.safetensors"]
    training = subprocess.Popen([*arguments, "--runners", "1"], stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120
    while time.monotonic() < until and not list(folder.glob("rllib-1*")):
        time.sleep(0.05)
    training.send_signal(signal.SIGINT)
    _, said = training.communicate(timeout=60)
    assert training.returncode == 130 and "run the same command to continue" in said, said
    assert "Traceback" not in said and not Path("p.safetensors").exists()
    first = load_checkpoint(load_experiment(config), folder, state=())
    assert first is not None and 1000 <= first.steps < 20_000
    steps, iterate = [], rllib._iterate

    def noted(algorithm: Any, experiment: Any, team: Any, run: Run, *others: Any) -> str:
        text = iterate(algorithm, experiment, team, run, *others)
        steps.append(run.steps)
        return text

    rllib._iterate = noted
    code, output = command(config, "--out", "p.safetensors")
    assert code == 0, output
    assert first.steps < steps[0] < first.steps + 2 * 16 * 32, steps
    run = load_checkpoint(load_experiment(config), folder, state=())
    assert run is not None and 20_000 <= run.steps < 21_000
    assert run.curve[: len(first.curve)] == first.curve and run.wall > first.wall
    assert [state.name for state in folder.glob("rllib-*")] == [f"rllib-{run.steps}"]
    next(folder.glob(f"rllib-{run.steps}")).rename(folder / "other")
    assert command(config, "--steps", "70000", "--out", "p.safetensors")[0] == 2  # another recipe
    code, output = command(config, "--out", "p.safetensors")
    assert code == 2 and f"is damaged: rllib-{run.steps} is missing" in output, output


def pursuers_and_evaders_learn_a_policy_each() -> None:
    """Both policies play the task of PettingZoo's environment, and act as RLlib's two modules."""
    code, output = command(small(steps=3000), "--team", "--worlds", "2", "--out", "p.safetensors", "--runners", "1")
    assert code == 0, output
    task = Pursuit(pursuers=3, evaders=2, sides="both")
    policies = {name: MlpPolicy.load(f"p-{name}.safetensors", task) for name in ("pursuer", "evader")}
    rows = np.random.default_rng(0).uniform(-1, 1, (100, task.layout.size)).astype(np.float32)
    experiment = rllib.settings_of(load_experiment("pursuit.yaml"), "role", False, {"worlds": 2})
    with rllib.built(experiment, "role", 0) as algorithm:
        algorithm.restore_from_path(next(Path("runs/rllib/pursuit-team").resolve().glob("rllib-*")))
        for name, policy in policies.items():
            module = algorithm.get_module(name)
            with torch.no_grad():
                outputs = module.forward_inference({Columns.OBS: torch.from_numpy(rows)})
            mean = np.clip(outputs[Columns.ACTION_DIST_INPUTS].numpy()[:, :2], -1, 1)
            assert np.abs(policy.predict(rows, deterministic=True)[0] - mean).max() < 1e-5
    acted = [policy.predict(rows, deterministic=True)[0] for policy in policies.values()]
    assert np.abs(acted[0] - acted[1]).max() > 0.1


def agents_of_a_team_learn_a_network_each_which_play_in_the_comparison() -> None:
    """They are one player: each learner acts as its own module, and their mean return is the learning curve."""
    options = ["--team", "--networks", "agent", "--worlds", "2", "--steps", "3000", "--out", "p.safetensors"]
    code, output = command(small("herd"), *options)
    assert code == 0, output
    task, card = Herd(dogs=2), read("p.json")
    assert card["networks"] == 2 and card["tuning_mean"] == max(point["mean"] for point in card["curve"])
    expected = "python -m agents.rllib herd.yaml --team --networks agent --steps 3000 --worlds 2"
    assert card["recipe"]["command"] == expected
    experiment = rllib.settings_of(load_experiment("herd.yaml"), "agent", False, {"worlds": 2, "steps": 3000})
    run = load_checkpoint(experiment, Path("runs/rllib/herd-team-agent"), state=())
    assert run is not None and len(run.curve) > 1
    rows = np.random.default_rng(0).uniform(-1, 1, (100, task.layout.size)).astype(np.float32)
    with rllib.built(experiment, "agent", 0) as algorithm:
        algorithm.restore_from_path(next(Path("runs/rllib/herd-team-agent").resolve().glob("rllib-*")))
        last = rllib.players_of(algorithm, task, "agent")[rllib.ONE]
        acted = MlpPolicy.of_tensors(last, {"activation": "tanh"}).predict(rows, deterministic=True)[0]
        for k, name in enumerate(task.agent_names):
            with torch.no_grad():
                outputs = algorithm.get_module(name).forward_inference({Columns.OBS: torch.from_numpy(rows[k::2])})
            mean = np.clip(outputs[Columns.ACTION_DIST_INPUTS].numpy()[:, :2], -1, 1)
            assert np.abs(acted[k::2] - mean).max() < 1e-5
    assert np.abs(last["action.weight"][0] - last["action.weight"][1]).max() > 0.01
    results, _ = compare.compare([task], players_in_order(["random", "p.safetensors"]), worlds=4, resamples=100)
    assert results["tasks"]["herd"]["players"].keys() == {"random", "p"}


CASES = (
    rows_are_those_of_the_native_environment,
    settings_without_an_equal_are_refused_in_one_line,
    a_policy_trained_with_a_runner_plays_in_the_comparison,
    an_exported_policy_acts_as_in_rllib,
    an_interrupted_training_continues,
    pursuers_and_evaders_learn_a_policy_each,
    agents_of_a_team_learn_a_network_each_which_play_in_the_comparison,
)

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as empty:
        os.chdir(empty)
        next(case for case in CASES if case.__name__ == sys.argv[1])()
