"""Train a policy with Stable-Baselines3's PPO: `python -m agents.ppo configs/pursuit.yaml`.

Reads top to bottom: settings -> worlds -> model -> learn -> export. Every so often the policy of the moment plays the
tuning worlds in numpy; that is the learning curve, and the best one is what is exported, as safetensors with a card
that holds the recipe. Ctrl-C keeps a checkpoint, `--resume` goes on from it, if the recipe is still the same.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnvWrapper

from agents.central import CentralPolicy, CentralVecEnv
from agents.credit import CaringBuffer
from agents.experiment import Experiment, PpoSettings, load_experiment, one_line_errors
from agents.teach import teach
from flockenv.crew import threads, use_threads
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import WEIGHTS
from flockenv.players.rules import as_dict, player
from flockenv.policy import MlpPolicy, describe, save_policy
from flockenv.refusals import KeyPath, key_path, shown
from flockenv.sb3 import WorldVecEnv
from flockenv.tasks import TASKS, Task
from flockenv.world import World

__all__ = ["OtherRecipe", "app", "checkpointed", "on_threads", "tensors_of", "train"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)


class ForLearning(VecEnvWrapper):
    """What learning likes: small rewards, actions that tell, and worlds in different phases of their episodes.

    Rewards times a constant keep the value loss near 1, so that clipping gradients does not starve the policy. And
    where only the time limit ends an episode, worlds that began together would show every update one phase alone;
    staggered, their first episodes end one after another. What one noisy decision in ten per second changes is lost
    among the others; `hold` keeps to each for so many, and pays what they are paid together (Mnih et al. 2015). Where
    an episode ends among them, what the next one is paid until there is another decision is left out.
    """

    def __init__(self, venv: WorldVecEnv, scale: float, stagger: bool, hold: int = 1) -> None:
        super().__init__(venv)
        self.scale, self.stagger, self.hold = scale, stagger, hold
        self.here = np.ones(venv.num_envs, np.bool_)  # who was there when the last step began

    def reset(self) -> np.ndarray:
        """Begin; staggered, each world with another part of its first episode behind it."""
        observation = self.venv.reset()
        if self.stagger:
            world: World = self.venv.world
            world.steps[:] = np.arange(world.worlds) * world.task.horizon // world.worlds
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Take an action for every row."""
        world: World = self.venv.world
        self.here = world.state.alive[:, : world.learners].reshape(-1).copy()
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Act for `hold` decisions of the world, and scale what is paid."""
        observation, reward, done, infos = self.venv.step_wait()
        for _ in range(self.hold - 1):
            self.venv.step_async(self.actions)
            observation, more, over, told = self.venv.step_wait()
            reward += np.where(done, 0.0, more)
            if any(told[:: self.venv.world.learners]):  # all rows of a world are told of its end
                infos = [before or new for before, new in zip(infos, told, strict=True)]
            done = done | over
        return observation, reward * self.scale, done, infos


class OtherRecipe(ValueError):  # noqa: N818  # whoever begins anew then has seen no error
    """A checkpoint is of another recipe than the one to train by."""


def recipe_of(experiment: Experiment) -> dict[str, Any]:
    """Return all that training depends on: with another value anywhere it is another training."""
    task, told = experiment.build(), experiment.model_dump(mode="json", include={"task", "arguments", "ppo"})
    if experiment.ppo.taught:
        told["rules"] = as_dict(player(task).rules)  # who taught it
    return {**told, "layout": task.layout.digest}


@dataclass
class Run:
    """What training has come to so far; all that a checkpoint holds beside the network."""

    recipe: dict[str, Any]
    steps: int = 0
    wall: float = 0.0  # s, with what teaching took
    curve: list[dict[str, float]] = field(default_factory=list)
    best: float = -np.inf
    tensors: dict[str, np.ndarray] = field(default_factory=dict)


def tensors_of(model: PPO) -> dict[str, np.ndarray]:
    """Return the actor's weights under the names that flockenv.policy reads; the critic stays behind."""
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


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Let torch and the worlds use so many threads; afterwards each uses as many as before."""
    before = torch.get_num_threads(), threads()
    torch.set_num_threads(count)
    use_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        use_threads(before[1])


def build(task: Task, p: PpoSettings, tensorboard: str | None) -> PPO:
    """Make the worlds and the model; how many threads they use is for `on_threads` to say."""
    torch.manual_seed(p.seed)
    learned = task.model_copy(update={"dtype": p.dtype})
    shows = CentralVecEnv if p.central_critic else WorldVecEnv
    worlds = ForLearning(shows(learned, p.worlds, leaving=not task.ends_together), p.reward_scale, p.stagger, p.hold)
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
        learning_rate=lambda left: p.learning_rate * max(0.1 + 0.9 * left, 0.05),  # the last rollout may go beyond
        gamma=p.gamma,
        gae_lambda=p.gae_lambda,
        clip_range=p.clip,
        ent_coef=p.entropy,
        seed=p.seed,
        device="cpu",
        tensorboard_log=tensorboard,
        policy_kwargs={
            "net_arch": {"pi": list(p.hidden), "vf": list(p.hidden)},
            "activation_fn": {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[p.activation],
            "log_std_init": p.log_std,
            **({"seen": task.layout.size} if p.central_critic else {}),
        },
        **caring,
    )
    if tensorboard is None:
        model.set_logger(Logger(folder=None, output_formats=[]))  # its own leaves an empty folder behind
    worlds.seed(worlds_for("training", p.seed, p.worlds))
    return model


def score(task: Task, p: PpoSettings, tensors: dict[str, np.ndarray]) -> tuple[float, float]:
    """Return the mean return and the success rate of a policy, without noise, on the tuning worlds."""
    policy = MlpPolicy(tensors, {"activation": p.activation})
    episodes = rollout(task, policy, p.evaluate_worlds, worlds_for("tuning", p.seed, p.evaluate_worlds))
    return float(np.mean(episodes.returns)), float(np.mean(episodes.success))


class Watch(BaseCallback):
    """After each rollout: the progress bar; every so often: a point of the learning curve, and a checkpoint."""

    def __init__(self, task: Task, p: PpoSettings, run: Run, folder: Path, progress: Progress) -> None:
        super().__init__()
        self.task, self.p, self.run, self.folder, self.progress = task, p, run, folder, progress
        self.bar = progress.add_task(task.name, total=p.steps, completed=run.steps, score="")
        self.since, self.before = time.perf_counter(), run.wall

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.run.steps = self.num_timesteps * self.p.hold
        policy, waits = self.model.policy, self.run.steps <= self.p.critic_first
        for part in (policy.mlp_extractor.policy_net, policy.action_net):
            part.requires_grad_(not waits)
        policy.log_std.requires_grad_(not waits)
        self.progress.update(self.bar, completed=min(self.run.steps, self.p.steps))
        due = len(self.run.curve) * self.p.evaluate_every
        if self.run.steps >= due:
            self.point()

    def point(self) -> None:
        """Measure the policy of the moment, keep it if it is the best so far, and write a checkpoint."""
        self.run.wall = self.before + time.perf_counter() - self.since
        self.run.steps = self.num_timesteps * self.p.hold
        tensors = tensors_of(self.model)
        result, success = score(self.task, self.p, tensors)
        seconds = round(self.run.wall, 1)
        self.run.curve.append({"steps": self.run.steps, "seconds": seconds, "mean": result, "success": success})
        if result > self.run.best:
            self.run.best, self.run.tensors = result, tensors
        self.progress.update(self.bar, score=f"{result:.2f}, success {success:.0%}, best {self.run.best:.2f}")
        line = f"{self.run.steps:>12,} steps {seconds:7.1f} s  mean {result:8.3f}  success {success:.3f}"
        self.progress.console.print(line)
        checkpoint(self.folder, self.model, self.run)


def checkpoint(folder: Path, model: PPO, run: Run) -> None:
    """Write the run so far; each file is either the old one or the whole new one."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(model.policy.state_dict(), folder / "policy.tmp")
    torch.save(model.policy.optimizer.state_dict(), folder / "optimizer.tmp")
    np.savez(folder / "best.tmp.npz", **run.tensors)
    notes = {name: value for name, value in vars(run).items() if name != "tensors"}
    (folder / "run.tmp").write_text(json.dumps(notes), encoding="utf-8")
    finals = {
        "policy.tmp": "policy.pt",
        "optimizer.tmp": "optimizer.pt",
        "best.tmp.npz": "best.npz",
        "run.tmp": "run.json",
    }
    for name, final in finals.items():
        os.replace(folder / name, folder / final)


def checkpointed(experiment: Experiment, folder: Path) -> Run | None:
    """Return the run whose checkpoint lies in a folder, if there is one; OtherRecipe if it is not of this experiment.

    No file of a checkpoint can execute code.
    """
    path = folder / "run.json"
    if not path.exists():
        return None
    notes = json.loads(path.read_text(encoding="utf-8"))
    kept, wanted = dict(_numbers(notes.get("recipe", {}))), dict(_numbers(recipe_of(experiment)))
    for key in {**wanted, **kept}:
        if kept.get(key) != wanted.get(key):
            has, asked = (shown(of[key]) if key in of else "nothing" for of in (kept, wanted))
            raise OtherRecipe(f"{key} = {asked}: the checkpoint in {folder} is of another recipe, with {has}")
    with np.load(folder / "best.npz", allow_pickle=False) as best:
        return Run(**notes, tensors={name: best[name] for name in best.files})


def _kept(experiment: Experiment, folder: Path) -> bool:
    """Is there something to go on from?"""
    try:
        return checkpointed(experiment, folder) is not None
    except OtherRecipe:
        return False


def _numbers(block: dict[str, Any], path: KeyPath = ()) -> Iterator[tuple[str, Any]]:
    """Yield every value of nested blocks by its key path."""
    for key, value in block.items():
        if isinstance(value, dict):
            yield from _numbers(value, (*path, key))
        else:
            yield key_path((*path, key)), value


def _teach(model: PPO, task: Task, p: PpoSettings) -> float:
    """Let the network first learn what the tuned rules answer, if it is to; return the seconds that took."""
    if p.taught == 0:
        return 0.0
    began = time.perf_counter()
    with on_threads(p.threads), Progress(console=console, transient=True) as progress:
        bar = progress.add_task(f"{task.name}: is taught", total=p.taught)
        teach(model, task, player(task), p.taught, advance=lambda n: progress.advance(bar, n))
    return time.perf_counter() - began


def resume(folder: Path, model: PPO, run: Run, p: PpoSettings) -> None:
    """Read a checkpoint's networks back into the model."""
    model.policy.load_state_dict(torch.load(folder / "policy.pt", weights_only=True))
    model.policy.optimizer.load_state_dict(torch.load(folder / "optimizer.pt", weights_only=True))
    model.num_timesteps = run.steps // p.hold


def train(experiment: Experiment, folder: Path, go_on: bool = False, tensorboard: str | None = None) -> Run:
    """Train to the end of the budget, or until Ctrl-C; return what came of it.

    go_on: from the folder's checkpoint, if there is one; a finished one is returned as it is. OtherRecipe if it is not
    of this experiment: weights that two recipes made have none.
    """
    task, p = experiment.build(), experiment.ppo
    run = checkpointed(experiment, folder) if go_on else None
    if run is not None and run.steps >= p.steps:
        return run
    model = build(task, p, tensorboard)
    if run is not None:
        resume(folder, model, run, p)
    else:
        run = Run(recipe_of(experiment))
        run.wall = _teach(model, task, p)
        (folder / "run.json").unlink(missing_ok=True)  # what is there is overwritten file by file
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[score]}"),
    )  # fmt: skip
    with on_threads(p.threads), Progress(*columns, console=console) as progress:
        watch = Watch(task, p, run, folder, progress)
        try:
            model.learn(
                -(-(p.steps - run.steps) // p.hold),
                callback=watch,
                reset_num_timesteps=run.steps == 0,
                log_interval=None,
            )
            watch.point()
        except KeyboardInterrupt:
            watch.point()
            raise
    return run


def export(run: Run, path: Path) -> None:
    """Write the best policy with its recipe: everything that is needed to make it again."""
    recipe = run.recipe
    card = {
        **describe(TASKS[recipe["task"]](**recipe["arguments"])),
        **({"rules": recipe["rules"]} if "rules" in recipe else {}),
        "activation": recipe["ppo"]["activation"],
        "algorithm": "PPO (stable-baselines3)",
        "recipe": {"command": f"python -m agents.ppo configs/{recipe['task']}.yaml", "ppo": recipe["ppo"]},
        "seed": recipe["ppo"]["seed"],
        "steps": run.steps,
        "wall_time_s": round(run.wall, 1),
        "tuning_mean": run.best,
        "curve": run.curve,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": {name: version(name) for name in ("stable-baselines3", "torch", "numpy", "gymnasium")},
    }
    save_policy(path, run.tensors, card)


@app.command()
def main(
    config: Annotated[Path, typer.Argument(help="an experiment, such as configs/pursuit.yaml")],
    out: Annotated[Path | None, typer.Option(help="default: flockenv/players/weights/TASK.safetensors")] = None,
    runs: Annotated[Path, typer.Option(help="folder of checkpoints")] = Path("runs"),
    go_on: Annotated[bool, typer.Option("--resume", help="go on from the last checkpoint")] = False,
    tensorboard: Annotated[str | None, typer.Option(help="folder of TensorBoard logs")] = None,
    steps: Annotated[int | None, typer.Option(help="agent-steps in all, instead of the config's")] = None,
    seed: Annotated[int | None, typer.Option(help="instead of the config's")] = None,
) -> None:
    """Train a policy with PPO and export its weights."""
    with one_line_errors():
        experiment = load_experiment(config)
        changes = {k: v for k, v in (("steps", steps), ("seed", seed)) if v is not None}
        experiment = experiment.model_copy(update={"ppo": PpoSettings(**{**experiment.ppo.model_dump(), **changes})})
        task = experiment.build()
        if go_on:
            checkpointed(experiment, runs / task.name)  # of another recipe: refused before anything is built
    target = out or WEIGHTS / f"{task.name}.safetensors"
    try:
        run = train(experiment, runs / task.name, go_on, tensorboard)
    except KeyboardInterrupt:
        kept = f"checkpoint in {runs / task.name}, go on with --resume"
        console.print(f"interrupted; {kept if _kept(experiment, runs / task.name) else 'nothing was learnt yet'}")
        raise typer.Exit(130) from None
    export(run, target)
    best = f"mean return {run.best:.3f} on the tuning worlds"
    console.print(f"{target}: {best} after {run.steps:,} steps, {run.wall:.0f} s")


if __name__ == "__main__":
    app()
