"""Train a policy with Stable-Baselines3's PPO: `python -m agents.ppo configs/training/pursuit.yaml`.

The order of the file: settings -> worlds -> model -> learn -> export. At regular intervals the current policy plays the
tuning worlds in numpy, which gives the learning curve; the best policy is exported, as safetensors with a card that
holds the recipe. After each point of the curve, and on Ctrl-C, a checkpoint (agents/checkpoint.py) is written, with the
state at the start of the last rollout; `--resume` continues from it if the recipe is the same. A training that was
resumed under the same versions on the same machine has the same weights as an uninterrupted one, bit for bit, unless
`ppo.seconds` is set: then the learning rate and the end depend on the clock.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from agents.central_critic import CentralPolicy, CentralVecEnv
from agents.checkpoint import CheckpointError, claim, path_in
from agents.dagger import teach
from agents.divergence import check_answers, check_model
from agents.drawn import check_settings
from agents.experiment import Experiment, PpoSettings, load_experiment, one_line_errors, seeds_of
from agents.options import Config, Seconds, Steps, TrainingSeed
from agents.run import Run, expected_bytes, load_checkpoint, recipe_of, save_checkpoint
from agents.team_credit import CaringBuffer
from agents.training import (
    BudgetSpent,
    add_point,
    card_of,
    is_spent,
    new_progress,
    score,
    share_of_time_left,
    use_thread_count,
)
from agents.training_env import learning_env
from agents.training_job import file_name, policy_of_bytes, training_job, with_seed
from agents.training_log import log_point, turn_off_log, write_log
from agents.training_state import capture, restore, surroundings
from agents.warm_start import starting_policy, use_weights
from flockenv.cli.jobs import EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.terminal import DIVERGED, handle_interrupt, job_bar, run_program, show_progress
from flockenv.core import signals
from flockenv.core.address_space import IN_USE, TRAINING, require_room
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.evaluation import worlds_for
from flockenv.jobs import Job, Store, Work, engine_of, run_jobs
from flockenv.players import WEIGHTS
from flockenv.players.policy import save_policy
from flockenv.players.rules import player
from flockenv.tasks import Task

__all__ = ["app", "build", "export", "learning_rate", "run_trainings", "tensors_of", "train"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)


def tensors_of(model: PPO) -> dict[str, np.ndarray]:
    """Return the actor's weights under the names that flockenv.players.policy reads; the critic is left out."""
    tensors = model.policy.state_dict().items()
    state = {name: tensor.detach().cpu().numpy().astype(np.float32) for name, tensor in tensors}
    out = {"log_std": state["log_std"]}
    for part in ("weight", "bias"):
        out[f"action.{part}"] = state[f"action_net.{part}"]
    layers = sorted({int(name.split(".")[2]) for name in state if name.startswith("mlp_extractor.policy_net.")})
    for k, layer in enumerate(layers):
        for part in ("weight", "bias"):
            out[f"policy.{k}.{part}"] = state[f"mlp_extractor.policy_net.{layer}.{part}"]
    return {name: tensor.copy() for name, tensor in out.items()}


def learning_rate(p: PpoSettings) -> Callable[[float], float]:
    """Return the learning rate as a function of the share of the budget that is left."""
    return lambda left: p.learning_rate * max(0.1 + 0.9 * left, 0.05)  # the last rollout may go beyond


def build(task: Task, p: PpoSettings) -> PPO:
    """Return the model with its worlds; `use_thread_count` sets how many threads they use.

    Raises MemoryError if too little address space is left to train: starting torch's threads would abort the process.
    """
    require_room(f"to train, {IN_USE}", TRAINING)
    torch.manual_seed(p.seed)
    worlds = learning_env(task, p, CentralVecEnv if p.central_critic else WorldVecEnv)
    caring: dict[str, Any] = {}
    if p.care:
        caring["rollout_buffer_class"] = CaringBuffer
        caring["rollout_buffer_kwargs"] = {"worlds": worlds, "learners": task.learners, "care": p.care}
    model = PPO(
        CentralPolicy if p.central_critic else "MlpPolicy",
        worlds,
        n_steps=p.rollout,
        batch_size=p.minibatch,
        n_epochs=p.epochs,
        learning_rate=learning_rate(p),
        gamma=p.gamma,
        gae_lambda=p.gae_lambda,
        clip_range=p.clip,
        ent_coef=p.entropy,
        seed=p.seed,
        device="cpu",
        policy_kwargs={
            "net_arch": {"pi": list(p.hidden), "vf": list(p.hidden)},
            "activation_fn": {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[p.activation],
            "log_std_init": p.log_std,
            **({"seen": task.layout.size} if p.central_critic else {}),
        },
        **caring,
    )
    turn_off_log(model)
    worlds.seed(worlds_for("training", p.seed, p.worlds))
    return model


class Watch(BaseCallback):
    """Updates the progress bar after each rollout; adds points of the learning curve and checkpoints at intervals."""

    def __init__(
        self, task: Task, p: PpoSettings, run: Run, folder: Path, progress: Progress, saved: Callable[[Run], None]
    ) -> None:
        super().__init__()
        self.task, self.p, self.run, self.folder, self.progress = task, p, run, folder, progress
        self.saved = saved
        self.bar = progress.add_task(task.name, total=p.steps, completed=run.steps, score="")
        self.since, self.before = time.perf_counter(), run.wall
        self.kept: Run | None = None  # the state at the start of the last rollout
        self.due = True

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        """Let the learning rate follow the budget of which less is left, agent-steps or seconds."""
        rate = learning_rate(self.p)
        self.model.lr_schedule = lambda left: rate(min(left, share_of_time_left(self.p, self.wall)))

    @property
    def wall(self) -> float:
        """Wall time in all, s."""
        return self.before + time.perf_counter() - self.since

    def _on_rollout_start(self) -> None:
        check_model(self.model)
        self._remember()
        if share_of_time_left(self.p, self.run.wall) <= 0:
            raise BudgetSpent
        if self.due:
            self.save()

    def _remember(self) -> None:
        """Store the state of training at this moment, for the next checkpoint."""
        self.run.wall = self.wall
        self.run.state = capture(self.model)
        self.kept = replace(self.run, curve=list(self.run.curve))

    def save(self) -> None:
        """Write a checkpoint of the stored state, if there is one."""
        if self.kept is not None:
            save_checkpoint(self.folder, self.kept)
            self.saved(self.kept)
        self.due = False

    def _on_rollout_end(self) -> None:
        self.run.steps = self.num_timesteps * self.p.hold
        policy, waits = self.model.policy, self.run.steps <= self.p.critic_first
        for part in (policy.mlp_extractor.policy_net, policy.action_net):
            part.requires_grad_(not waits)
        policy.log_std.requires_grad_(not waits)
        self.progress.update(self.bar, completed=min(self.run.steps, self.p.steps))
        due = len(self.run.curve) * self.p.evaluate_every
        if self.run.steps >= due:
            self.add_point()

    def add_point(self) -> None:
        """Evaluate the current policy, and keep it if it is the best so far; a checkpoint is then due."""
        self.run.wall = self.wall
        self.run.steps = self.num_timesteps * self.p.hold
        tensors = tensors_of(self.model)
        text, line = add_point(self.run, tensors, score(self.task, self.p, tensors))
        self.progress.update(self.bar, score=text)
        self.progress.console.print(line)
        log_point(self.model.logger, self.run.curve[-1])
        self.due = True

    def finish(self) -> None:
        """Evaluate the last policy, and write the last checkpoint."""
        check_model(self.model)
        self.add_point()
        self.logger.dump(self.num_timesteps)
        self._remember()
        self.save()


def _teach_first(model: PPO, task: Task, p: PpoSettings) -> float:
    """Train the network to imitate the tuned rules, if the settings require it; return the time that took, s."""
    if p.taught == 0:
        return 0.0
    began = time.perf_counter()
    with use_thread_count(p.threads), show_progress(Progress(console=console, transient=True)) as progress:
        bar = progress.add_task(f"{task.name}: imitation", total=p.taught)
        teach(model, task, player(task), p.taught, advance=lambda n: progress.advance(bar, n))
    return time.perf_counter() - began


def resume(folder: Path, model: PPO, run: Run, p: PpoSettings) -> None:
    """Restore a model to the run of a checkpoint, and print which versions or machine parts have changed."""
    restore(model, run.state, run.steps // p.hold, folder)
    now, before = surroundings(model.get_env().get_attr("task", 0)[0]), dict(run.surroundings)
    for earlier in run.resumed:
        before |= earlier["surroundings"]
    if others := {name: value for name, value in now.items() if before.get(name) != value}:
        run.resumed.append({"steps": run.steps, "surroundings": others})
        changes = ", ".join(f"{name} {value} after {before.get(name, 'nothing')}" for name, value in others.items())
        text = f"resumed under {changes}: weights may differ from those of an uninterrupted training"
        console.print(text, markup=False, highlight=False, soft_wrap=True)


def train(
    experiment: Experiment,
    folder: Path,
    go_on: bool = False,
    saved: Callable[[Run], None] = lambda run: None,
) -> Run:
    """Train to the end of the budget, or until Ctrl-C; return the run.

    Args:
        experiment: task and settings.
        folder: of the checkpoint and of the log.
        go_on: continue from the folder's checkpoint, if there is one; a finished run is returned as it is.
        saved: called with the run of the checkpoint from which training continues, and of each that it writes.

    Raises:
        OtherRecipe: the checkpoint has another recipe; weights of mixed recipes could not be reproduced.
        CheckpointError: it is damaged, or another training holds the folder.
        FloatingPointError: learning or a world diverged; the checkpoint has the last state before that.
    """
    with claim(folder):
        run = load_checkpoint(experiment, folder) if go_on else None
        if run is not None:
            saved(replace(run, curve=list(run.curve), resumed=list(run.resumed)))
        if run is not None and is_spent(run, experiment.ppo):
            return run
        if go_on and run is None:
            console.print(
                f"no checkpoint in {folder}: training starts from the beginning",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )
        return _train_from(experiment, folder, run, saved)


def _train_from(experiment: Experiment, folder: Path, run: Run | None, saved: Callable[[Run], None]) -> Run:
    task, p, anew = experiment.build(), experiment.ppo, run is None
    with use_thread_count(p.threads):  # the first weights depend on it
        model = build(task, p)
    if run is not None:
        resume(folder, model, run, p)
    else:
        run = Run(recipe_of(experiment), surroundings(model.get_env().get_attr("task", 0)[0]))
        run.wall = _teach_first(model, task, p)
        if p.start is not None:
            use_weights(model, starting_policy(p, task))
    with use_thread_count(p.threads), show_progress(new_progress(console)) as progress:
        watch = Watch(task, p, run, folder, progress, saved)
        try:
            with write_log(model, folder, console), _name_divergence(model):
                with suppress(BudgetSpent):
                    model.learn(-(-(p.steps - run.steps) // p.hold), callback=watch, reset_num_timesteps=anew)
                watch.finish()
        except (KeyboardInterrupt, FloatingPointError):
            watch.save()
            raise
    return run


@contextmanager
def _name_divergence(model: PPO) -> Iterator[None]:
    """Raise LearningDiverged if torch cannot draw actions because the output of the network has diverged."""
    try:
        yield
    except ValueError:
        check_model(model)
        check_answers(model)
        raise


def export(run: Run, path: Path) -> None:
    """Write the best policy with its card."""
    save_policy(path, run.tensors, card_of(run))


@app.command()
def main(
    config: Config,
    out: Annotated[Path | None, typer.Option(help="default: flockenv/players/weights/TASK.safetensors")] = None,
    runs: Annotated[Path, typer.Option(help="folder of checkpoints and logs")] = Path("runs"),
    go_on: Annotated[bool, typer.Option("--resume", help="continue from the last checkpoint")] = False,
    steps: Steps = None,
    seconds: Seconds = None,
    seed: TrainingSeed = None,
    action: Annotated[
        str | None,
        typer.Option(help="force, residual, mixture, weights, priorities or gate, instead of the config's ppo.action"),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(help="several training seeds as jobs, 0-9 or 0,3; --out is then a folder [results/ppo]"),
    ] = None,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
) -> None:
    """Train a policy with PPO and export its weights."""
    with one_line_errors():
        experiment = load_experiment(config)
        experiment = experiment.with_ppo(steps=steps, seconds=seconds, seed=seed, action=action)
        name = experiment.build().name
        check_settings(experiment)
        if seeds is not None:
            if seed is not None or go_on:
                raise ValueError("--seeds: not together with --seed or --resume; it resumes by itself")
            folder = valid_path(str(out or "results/ppo"))
            work = Work(Store(folder / "jobs"), engine_of(engine, processes, renew=True), fresh, shard=shard_of(shard))
            checkpoints = valid_path(str(runs), "--runs")
            check_room(checkpoints / "checkpoint", expected_bytes(experiment))
            jobs = [training_job(with_seed(experiment, number), checkpoints, not fresh) for number in seeds_of(seeds)]
            with end_of_shard():
                run_trainings(jobs, folder, work, expected_bytes(experiment))
            return
        if shard is not None:
            raise ValueError("--shard: needs --seeds, whose trainings are jobs")
        target = WEIGHTS / f"{name}.safetensors" if out is None else valid_file(str(out), (".safetensors",), True)
        folder = valid_path(str(runs / name), "--runs")
        _check_outputs(experiment, target, folder)
    kept: deque[Run] = deque(maxlen=1)  # only the last one: a run holds all arrays of the model
    with handle_interrupt(), one_line_errors((CheckpointError, OSError)):
        try:
            run = train(experiment, folder, go_on, kept.append)
        except KeyboardInterrupt:
            stays = f"checkpoint in {runs / name}, go on with --resume" if kept else "nothing was learnt yet"
            signals.set_message(f"interrupted; {stays}")
            raise
        except FloatingPointError as error:
            typer.echo(f"error: {error}; {_export_last_good(kept, folder, target)}", err=True)
            raise typer.Exit(DIVERGED) from None
        export(run, target)
    best = f"mean return {run.best:.3f} on the tuning worlds"
    console.print(f"{target}: {best} after {run.steps:,} steps, {run.wall:.0f} s")


def run_trainings(jobs: list[Job], folder: Path, work: Work, size: int, stored: str = "checkpoints and ") -> None:
    """Run trainings as jobs, and write the policy of each that has ended; size: of a policy, bytes, at most."""
    check_room(folder / "policy", size)
    interrupted = f"interrupted; {stored}finished trainings are stored, run the same command to continue"
    with handle_interrupt(interrupted), job_bar("training") as progress:
        try:
            run_jobs(jobs, replace(work, progress=progress))
        finally:
            share = jobs if work.shard is None else work.shard.of(jobs)
            for job in filter(work.store.has, share):
                tensors, card = work.store.read(job, policy_of_bytes)
                save_policy(folder / file_name(job), tensors, card)
                mean = f"mean return {card['tuning_mean']:.3f} on the tuning worlds"
                console.print(f"{folder / file_name(job)}: {mean}", soft_wrap=True, highlight=False)


def _check_outputs(experiment: Experiment, target: Path, folder: Path) -> None:
    """Raise ValueError or OSError, in one line, before any training, if an output cannot be written."""
    if target.with_suffix(".json").is_dir():
        raise ValueError(f"--out {str(target)!r}: its card, {target.with_suffix('.json').name!r}, is a folder")
    for path in (target, path_in(folder)):
        check_room(path, expected_bytes(experiment))


def _export_last_good(saved: Sequence[Run], folder: Path, target: Path) -> str:
    """Export the best policy of a training that diverged, if it has saved one; return what is kept, and where."""
    if not saved:
        return "nothing was learnt before"
    run = saved[-1]
    kept = f"kept: the checkpoint of {run.steps:,} steps in {folder}"
    if run.best is None:
        return kept
    try:
        export(run, target)
    except OSError as error:
        return f"{kept}; {error}"
    return f"{kept}, and the best policy so far (mean return {run.best:.3f}) in {target}"


if __name__ == "__main__":
    run_program("ppo", app)
