"""The speed of RLlib's PPO by the number of remote runners: `python -m benchmarks.rllib`, in an environment with RLlib.

Agent-steps per second of whole iterations of agents.rllib, sampling and learning, after a first iteration that is not
counted; runs with 0, 1 and 2 runners take turns. Of that time, the share of sampling is that of RLlib's own timers.
"""

from __future__ import annotations

import json
import statistics
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from agents.experiment import CONFIGS, Experiment, load_experiment
from agents.rllib import built, settings_of, start
from benchmarks.measure import command_line
from flockenv.core.atomic_files import new_folder, replace_file

TIMERS = {"sampling": "env_runner_sampling_timer", "learning": "learner_update_timer"}


def sample(experiment: Experiment, runners: int, seconds: float) -> dict[str, Any]:
    """Return agent-steps per second, and seconds per iteration of sampling and of learning."""
    with built(experiment, None, runners) as algorithm:
        first = _agent_steps(algorithm.train())
        began, result = time.perf_counter(), {}
        while (took := time.perf_counter() - began) < seconds or not result:
            result = algorithm.train()
        timers = {name: result["timers"][timer] for name, timer in TIMERS.items()}
        return {"agent_steps_per_s": (_agent_steps(result) - first) / took, "seconds_per_iteration": timers}


def _agent_steps(result: dict[str, Any]) -> int:
    return int(sum(result["env_runners"]["num_agent_steps_sampled_lifetime"].values()))


def main(
    task: Annotated[str, typer.Option(help="Task, with the settings of configs/training/TASK.yaml.")] = "pursuit",
    runners: Annotated[list[int] | None, typer.Option(help="Numbers of runners. [0, 1 and 2]")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds in which they take turns.")] = 3,
    seconds: Annotated[float, typer.Option(help="Least duration of a sample.")] = 20.0,
    out: Annotated[Path, typer.Option(help="File for all samples.")] = Path("results/benchmarks/rllib.json"),
) -> None:
    """Measure how many agent-steps RLlib's PPO learns from per second."""
    experiment = settings_of(load_experiment(CONFIGS / f"{task}.yaml"), None, True, {})
    start()
    counts = runners or [0, 1, 2]
    samples: dict[int, list[dict[str, Any]]] = {count: [] for count in counts}
    for _ in range(rounds):
        for count in counts:
            samples[count].append(sample(experiment, count, seconds))
    for count, found in samples.items():
        speeds = [each["agent_steps_per_s"] for each in found]
        print(
            f"{count} runners: {statistics.median(speeds):,.0f} agent-steps/s ({min(speeds):,.0f}-{max(speeds):,.0f})"
        )
    with new_folder(out.parent), replace_file(out) as file:
        content = {"task": task, "settings": experiment.ppo.model_dump(mode="json"), "samples": samples}
        file.write(json.dumps(content, indent=1).encode())


if __name__ == "__main__":
    command_line(main)()
