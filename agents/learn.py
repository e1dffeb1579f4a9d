"""Train a policy by another learner than PPO: `python -m agents.learn configs/training/crossing.yaml --algo sac`.

The learners are Stable-Baselines3's SAC, sb3-contrib's TQC and RecurrentPPO, and behaviour cloning of the tuned rules.
The order of the file: settings -> worlds and model -> learn -> export. Worlds, learning curve, budgets and the exported
files are those of agents.ppo: settings that PPO shares with a learner are under `ppo` (SHARED), its own under its name.

There is no checkpoint. Interrupted by Ctrl-C, a training writes its best policy so far; it does not resume, because it
would need the replay buffer (or, for RecurrentPPO, the states of its LSTM).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from agents import ppo
from agents.dagger import teach
from agents.divergence import LearningDiverged, diverged_weight
from agents.drawn import check_settings
from agents.experiment import Experiment, load_experiment, one_line_errors, seeds_of
from agents.learner_job import ALGORITHMS, check_memory, effective, learner_job, learner_recipe
from agents.options import Config, Seconds, Steps, TrainingSeed
from agents.run import Run, expected_bytes
from agents.training import (
    BudgetSpent,
    add_point,
    card_of,
    command_of,
    new_progress,
    score,
    share_of_time_left,
    use_thread_count,
)
from agents.training_env import learning_env
from agents.training_job import with_seed
from agents.training_log import log_point, turn_off_log, write_log
from agents.training_state import surroundings
from flockenv.cli.jobs import EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.terminal import DIVERGED, handle_interrupt, run_program, show_progress
from flockenv.core import signals
from flockenv.core.address_space import IN_USE, TRAINING, require_room
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.evaluation import worlds_for
from flockenv.jobs import Store, Work, engine_of
from flockenv.players.policy import save_policy
from flockenv.players.rules import player

__all__ = ["app", "build", "card", "export", "new_run", "tensors_of", "train"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)
Tensors = dict[str, np.ndarray]

NAMES = {
    "sac": "SAC (stable-baselines3)", "tqc": "TQC (sb3-contrib)", "recurrent_ppo": "RecurrentPPO (sb3-contrib)",
    "bc": "behaviour cloning",
}  # fmt: skip
"""What a card says of each learner."""

LARGEST = 1e8
"""A network with a larger weight has diverged, even if the weight is finite."""


# --- worlds and model -------------------------------------------------------------------------------------------------


def build(experiment: Experiment, algo: str) -> BaseAlgorithm:
    """Return the model of an experiment that `effective` made, with its worlds."""
    task, p = experiment.build(), experiment.ppo
    if algo == "bc":
        return ppo.build(task, p.model_copy(update={"worlds": 1, "minibatch": p.rollout}))  # for its network
    require_room(f"to train, {IN_USE}", TRAINING)
    torch.manual_seed(p.seed)
    worlds = learning_env(task, p)
    activation = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[p.activation]
    model: BaseAlgorithm
    if algo == "recurrent_ppo":
        model = _recurrent(experiment, worlds, activation)
    else:
        model = _off_policy(experiment, algo, worlds, activation)
    turn_off_log(model)
    worlds.seed(worlds_for("training", p.seed, p.worlds))
    return model


def _recurrent(experiment: Experiment, worlds: Any, activation: type[torch.nn.Module]) -> RecurrentPPO:
    """Return PPO whose actor has an LSTM; the critic reads its output too, but does not train it."""
    p = experiment.ppo
    return RecurrentPPO(
        "MlpLstmPolicy",
        worlds,
        n_steps=p.rollout,
        batch_size=p.minibatch,
        n_epochs=p.epochs,
        learning_rate=ppo.learning_rate(p),
        gamma=p.gamma,
        gae_lambda=p.gae_lambda,
        clip_range=p.clip,
        ent_coef=p.entropy,
        seed=p.seed,
        device="cpu",
        policy_kwargs={
            "net_arch": {"pi": list(p.hidden), "vf": list(p.hidden)},
            "activation_fn": activation,
            "log_std_init": p.log_std,
            "lstm_hidden_size": experiment.recurrent_ppo.lstm,
            "shared_lstm": True,
            "enable_critic_lstm": False,
        },
    )


def _off_policy(experiment: Experiment, algo: str, worlds: Any, activation: type[torch.nn.Module]) -> SAC | TQC:
    """Return SAC or TQC: after each action of all rows, one gradient step per `actions_per_update` of them."""
    p, own = experiment.ppo, getattr(experiment, algo)
    return {"sac": SAC, "tqc": TQC}[algo](
        "MlpPolicy",
        worlds,
        learning_rate=own.learning_rate,
        buffer_size=own.buffer,
        learning_starts=own.random_actions,
        batch_size=own.minibatch,
        tau=own.tau,
        ent_coef=f"auto_{own.entropy_weight}",
        gamma=p.gamma,
        train_freq=1,
        gradient_steps=max(1, round(worlds.num_envs / own.actions_per_update)),
        seed=p.seed,
        device="cpu",
        policy_kwargs={"net_arch": list(p.hidden), "activation_fn": activation},
    )


def tensors_of(model: BaseAlgorithm) -> Tensors:
    """Return the actor's weights under the names that flockenv.players.policy reads; critics are left out."""
    if isinstance(model, RecurrentPPO):
        lstm = {k: v.detach().numpy().astype(np.float32) for k, v in model.policy.lstm_actor.state_dict().items()}
        weights = {f"lstm.{name}": lstm[f"{name}_l0"].copy() for name in ("weight_ih", "weight_hh")}
        return {**ppo.tensors_of(model), **weights, "lstm.bias": lstm["bias_ih_l0"] + lstm["bias_hh_l0"]}
    if isinstance(model, PPO):
        return ppo.tensors_of(model)
    state = {k: v.detach().numpy().astype(np.float32) for k, v in model.policy.actor.state_dict().items()}
    layers = sorted({int(name.split(".")[1]) for name in state if name.startswith("latent_pi.")})
    names = {f"latent_pi.{layer}": f"policy.{k}" for k, layer in enumerate(layers)}
    names |= {"mu": "action", "log_std": "log_std"}
    return {f"{b}.{part}": state[f"{a}.{part}"].copy() for a, b in names.items() for part in ("weight", "bias")}


# --- learn ------------------------------------------------------------------------------------------------------------


class Recorder:
    """Adds points to the learning curve of a run, keeps its best policy, and ends it when its seconds are over."""

    def __init__(self, model: BaseAlgorithm, experiment: Experiment, run: Run, progress: Progress, total: int) -> None:
        self.model, self.task, self.p, self.run, self.progress = (
            model,
            experiment.build(),
            experiment.ppo,
            run,
            progress,
        )
        self.bar = progress.add_task(self.task.name, total=total, score="")
        self.since = time.perf_counter()

    @property
    def wall(self) -> float:
        """Wall time since the start of learning, s."""
        return time.perf_counter() - self.since

    def end_if_spent(self) -> None:
        """Raise BudgetSpent if the budget in seconds is spent; called between two updates."""
        self.run.wall = self.wall
        if share_of_time_left(self.p, self.run.wall) <= 0:
            raise BudgetSpent

    def add_point(self) -> None:
        """Evaluate the current policy on the tuning worlds, and keep it if it is the best so far."""
        check_weights(self.model)
        self.run.wall = self.wall
        tensors = tensors_of(self.model)
        text, line = add_point(self.run, tensors, score(self.task, self.p, tensors))
        self.run.wall = self.wall
        self.progress.update(self.bar, score=text)
        self.progress.console.print(line)
        log_point(self.model.logger, self.run.curve[-1])
        self.model.logger.dump(self.run.steps // self.p.hold)


class Watch(BaseCallback):
    """Measures the budget and the learning curve; for off-policy learners a rollout is one action of all rows."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__()
        self.recorder, self.points = recorder, 0

    def _on_training_start(self) -> None:
        """Let a falling learning rate follow the budget of which less is left, as in agents.ppo."""
        recorder = self.recorder
        if isinstance(self.model, RecurrentPPO):
            rate = ppo.learning_rate(recorder.p)
            self.model.lr_schedule = lambda left: rate(min(left, share_of_time_left(recorder.p, recorder.wall)))

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.recorder.end_if_spent()

    def _on_rollout_end(self) -> None:
        recorder, p = self.recorder, self.recorder.p
        recorder.run.steps = self.num_timesteps * p.hold
        recorder.progress.update(recorder.bar, completed=min(recorder.run.steps, p.steps))
        if recorder.run.steps >= self.points * p.evaluate_every:
            self.points = recorder.run.steps // p.evaluate_every + 1
            recorder.add_point()


def train(experiment: Experiment, algo: str, run: Run, folder: Path) -> None:
    """Train to the end of a budget, and store curve and best policy in `run`, which was made by `new_run`.

    folder: of the log.

    Raises:
        FloatingPointError: learning or a world diverged; `run` keeps the best policy until then.
    """
    p = experiment.ppo
    with use_thread_count(p.threads), show_progress(new_progress(console)) as progress:
        model = build(experiment, algo)
        recorder = Recorder(model, experiment, run, progress, p.steps if algo != "bc" else experiment.bc.updates)
        with write_log(model, folder, console), _name_divergence(model):
            ended_by = "steps"
            try:
                _clone(recorder, experiment) if algo == "bc" else _learn(recorder)
            except BudgetSpent:
                ended_by = "seconds"
            recorder.add_point()
            run.ended_by = ended_by


def _learn(recorder: Recorder) -> None:
    steps = -(-recorder.p.steps // recorder.p.hold)
    every = recorder.model.n_envs if isinstance(recorder.model, OffPolicyAlgorithm) else 1  # episodes, or rollouts
    recorder.model.learn(steps, callback=Watch(recorder), log_interval=every)


def _clone(recorder: Recorder, experiment: Experiment) -> None:
    """Train the actor of `recorder.model` to imitate the tuned rules."""
    task, own, run, done = experiment.build(), experiment.bc, recorder.run, 0

    def seen(rows: int) -> None:
        run.steps += rows

    def advance(updates: int) -> None:
        nonlocal done
        done += updates
        recorder.progress.update(recorder.bar, completed=done)
        if done % own.evaluate_updates == 0 and done < own.updates:
            recorder.add_point()
        recorder.end_if_spent()

    teach(recorder.model, task, player(task), own.updates, own.worlds, advance, own.rounds, seen)


def check_weights(model: BaseAlgorithm) -> None:
    """Raise LearningDiverged if a weight of a network is not finite."""
    if (name := diverged_weight(model)) is not None:
        raise LearningDiverged(f"weights of the network, {name}, are not finite after an update")


@contextmanager
def _name_divergence(model: BaseAlgorithm) -> Iterator[None]:
    """Raise LearningDiverged for an error of torch or of the worlds that comes from weights that are not finite."""
    try:
        yield
    except ValueError:
        check_weights(model)
        largest = max(float(tensor.detach().abs().max()) for tensor in model.policy.parameters())
        if largest > LARGEST:
            text = f"an action is out of range: the largest weight of the network is {largest:.3g}"
            raise LearningDiverged(text) from None
        raise


# --- export and command -----------------------------------------------------------------------------------------------


def new_run(experiment: Experiment, algo: str) -> Run:
    """Return the run of a training that begins."""
    versions = surroundings(experiment.build().model_copy(update={"dtype": experiment.ppo.dtype}))
    if "sb3-contrib" in NAMES[algo]:
        versions["sb3-contrib"] = version("sb3-contrib")
    return Run(learner_recipe(experiment, algo), versions)


def card(run: Run, algo: str) -> dict[str, Any]:
    """Return the card of a run's best policy."""

    def of_config(path: Path) -> dict[str, Any]:
        return learner_recipe(effective(load_experiment(path), algo), algo)

    command = command_of(run.recipe, "agents.learn", [f"--algo {algo}"], of_config)
    about = card_of(run, command=command)
    return {**about, "algorithm": NAMES[algo], "recipe": {**about["recipe"], algo: run.recipe[algo]}}


def export(run: Run, algo: str, path: Path) -> str:
    """Write the best policy so far with its card, if there is one; return what was written, in words."""
    if run.best is None:
        return "no policy was evaluated yet"
    save_policy(path, run.tensors, card(run, algo))
    return f"{path}: mean return {run.best:.3f} on the tuning worlds after {run.steps:,} steps, {run.wall:.0f} s"


@app.command()
def main(
    config: Config,
    algo: Annotated[str, typer.Option(help=f"{', '.join(ALGORITHMS)}; agents.ppo trains with PPO")],
    out: Annotated[Path | None, typer.Option(help="default: results/ALGO/TASK.safetensors")] = None,
    runs: Annotated[Path, typer.Option(help="folder of logs")] = Path("runs"),
    go_on: Annotated[bool, typer.Option("--resume", help="refused: these learners do not resume")] = False,
    steps: Steps = None,
    seconds: Seconds = None,
    seed: TrainingSeed = None,
    seeds: Annotated[
        str | None,
        typer.Option(help="several training seeds as jobs, 0-9 or 0,3; --out is then a folder [results/ALGO]"),
    ] = None,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
) -> None:
    """Train a policy with SAC, TQC, RecurrentPPO, or by behaviour cloning, and export its weights."""
    with one_line_errors():
        experiment = effective(load_experiment(config), algo, steps, seconds, seed)
        check_settings(experiment)
        if go_on:
            raise ValueError("--resume: these learners store no checkpoint, start anew without it; --seeds resumes")
        if seeds is not None and seed is not None:
            raise ValueError("--seeds: not together with --seed")
        if seeds is None and shard is not None:
            raise ValueError("--shard: needs --seeds, whose trainings are jobs")
        size, place = expected_bytes(experiment), valid_path(str(runs / algo / experiment.build().name), "--runs")
        check_room(place / "log", size)
        if seeds is not None:
            folder = valid_path(str(out or f"results/{algo}"))
            work = Work(Store(folder / "jobs"), engine_of(engine, processes, renew=True), fresh, shard=shard_of(shard))
            jobs = [learner_job(with_seed(experiment, number), algo, place) for number in seeds_of(seeds)]
            with end_of_shard():
                ppo.run_trainings(jobs, folder, work, size, stored="")
            return
        name = f"results/{algo}/{experiment.build().name}.safetensors"
        target = valid_file(str(out or name), (".safetensors",), True)
        check_room(target, size)
    check_memory(experiment, algo)
    _train_alone(experiment, algo, target, place)


def _train_alone(experiment: Experiment, algo: str, target: Path, place: Path) -> None:
    """Train in this process, and write the best policy, also of a training that is interrupted or diverges."""
    run = new_run(experiment, algo)
    with handle_interrupt(), one_line_errors():
        try:
            train(experiment, algo, run, place)
        except KeyboardInterrupt:
            run.ended_by = "interrupt"
            signals.set_message(f"interrupted; {export(run, algo, target)}")
            raise
        except FloatingPointError as error:
            run.ended_by = "divergence"
            typer.echo(f"error: {error}; {export(run, algo, target)}", err=True)
            raise typer.Exit(DIVERGED) from None
        console.print(export(run, algo, target), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_program("learn", app)
