"""Train a policy with RLlib's PPO: `python -m agents.rllib configs/training/pursuit.yaml --runners 1`.

The order of the file: settings -> algorithm -> weights -> learn -> evaluate -> export. Settings are
those of agents.ppo, of which RLlib has an equal. Each learner of each world is a row of the native vector environment;
with --team each is an agent of PettingZoo's parallel form, and agents of one role (pursuer, evader) share a network, or
all of them, or none (--networks).

After each iteration RLlib writes its own state, and beside it our checkpoint (agents/checkpoint.py) that names it. The
same command continues from there. RLlib does not store the state of environments: episodes begin anew then, so the
weights differ from those of an uninterrupted training. RLlib's state is pickled: continue only from your own folders.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import ray
import torch
import typer
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.tune.registry import register_env
from rich.console import Console
from stable_baselines3.common.logger import Logger

from agents.checkpoint import CheckpointError, Damaged, claim, path_in
from agents.divergence import LearningDiverged
from agents.experiment import Experiment, PpoSettings, load_experiment, one_line_errors
from agents.options import Config, Steps, TrainingSeed
from agents.rllib_envs import NETWORKS, ONE, RowsEnv, Settings, TeamEnv, role
from agents.run import Run, expected_bytes, load_checkpoint, recipe_of, save_checkpoint
from agents.training import add_point, card_of, new_progress, score, use_thread_count
from agents.training_log import log_point, open_log
from agents.training_state import surroundings
from flockenv.cli.terminal import DIVERGED, handle_interrupt, run_program, show_progress
from flockenv.core import signals
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.envs.table import ENVIRONMENTS
from flockenv.evaluation import Interval, bootstrap, worlds_for
from flockenv.jobs.ray_engine import start_ray
from flockenv.players.independent import stack_networks
from flockenv.players.policy import save_policy
from flockenv.tasks import Task

__all__ = ["algorithm_config", "app", "built", "evaluate", "layers", "settings_of", "start", "tensors_of", "train"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)
Tensors = dict[str, np.ndarray]

Networks = Literal["shared", "role", "agent"]
"""Which agents of a team share a network, see agents.rllib_envs; None: rows of the native environment share one."""

NO_EQUAL: dict[str, Any] = {
    "hold": 1, "care": 0.0, "central_critic": False, "taught": 0, "critic_first": 0, "draw": {}, "action": "force",
    "seconds": None,
}  # fmt: skip
"""Settings of which RLlib's PPO has no equal, with the value that it does have."""


LOSSES = ("total_loss", "policy_loss", "vf_loss", "entropy", "mean_kl_loss", "gradients_default_optimizer_global_norm")
"""What is logged of RLlib's metrics of a network."""


# --- settings ---------------------------------------------------------------------------------------------------------


def settings_of(experiment: Experiment, team: Networks | None, plain: bool, changes: dict[str, Any]) -> Experiment:
    """Return an experiment as RLlib can train it.

    team: with the arguments of the task's PettingZoo environment, where the experiment has none. plain: without the
    settings of which RLlib has no equal. changes: of settings of PPO.

    Raises:
        ValueError: a setting has no equal, or the task cannot be played in this form; one line.
    """
    kind, arguments = type(experiment.build()), experiment.arguments
    if team and (info := ENVIRONMENTS.get(kind.__name__)):
        arguments = {**info.parallel, **arguments}
    neutral = NO_EQUAL | ({"stagger": False} if team else {})
    p = PpoSettings(**{**experiment.ppo.model_dump(), **(neutral if plain else {}), **changes})
    for name, value in neutral.items():
        if getattr(p, name) != value:
            raise ValueError(f"ppo.{name} = {getattr(p, name)}: must be {value} with RLlib; --plain trains with that")
    experiment = experiment.model_copy(update={"arguments": arguments, "ppo": p})
    task = experiment.build()
    if team is not None and task.learners == 1:
        raise ValueError(f"--team: {task.name} has one learner; train it without --team")
    if team is None and not task.ends_together:
        raise ValueError(f"{task.name}: its learners leave one by one; train it with --team")
    return experiment


# --- algorithm --------------------------------------------------------------------------------------------------------


class Actor(DefaultPPOTorchRLModule):
    """RLlib's own actor and critic, with the recipe's first standard deviation."""

    def setup(self) -> None:
        """Build the networks."""
        super().setup()
        torch.nn.init.constant_(self.pi.log_std, self.model_config["first_log_std"])


def algorithm_config(
    experiment: Experiment, team: Networks | None, runners: int, evaluating: bool = False
) -> PPOConfig:
    """Return RLlib's settings of an experiment.

    evaluating: one world of the evaluation worlds instead of the training worlds, and rewards that are not scaled.

    Raises ValueError if the worlds cannot be shared equally among the runners.
    """
    task, p = experiment.build(), experiment.ppo
    worlds, rest = (1, 0) if evaluating else divmod(p.worlds, max(runners, 1))
    if rest:
        raise ValueError(f"--runners {runners}: must divide ppo.worlds = {p.worlds}")
    envs = worlds if team else worlds * task.learners
    batch, per_step = p.rollout * envs * max(runners, 1), task.learners if team else 1
    environment = _environment(experiment, runners, worlds, evaluating)
    register_env("flockenv-rows", RowsEnv)
    register_env("flockenv-team", TeamEnv)
    model = DefaultModelConfig(
        fcnet_hiddens=list(p.hidden), fcnet_activation=p.activation, free_log_std=True, vf_share_layers=False
    )
    actor = RLModuleSpec(module_class=Actor, model_config={**asdict(model), "first_log_std": p.log_std})
    config = (
        PPOConfig()
        .environment(
            "flockenv-team" if team else "flockenv-rows",
            env_config=environment,
            normalize_actions=False,  # the environments clip actions to [-1, 1] themselves
            clip_actions=False,
        )
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=envs,
            rollout_fragment_length=p.rollout,
            gym_env_vectorize_mode="sync" if team else "vector_entry_point",
        )
        .training(**_ppo_settings(p, batch, per_step))
        .debugging(seed=p.seed, log_level="ERROR")
    )
    if team is not None:
        policies = sorted({NETWORKS[team](agent) for agent in task.agent_names})
        config.multi_agent(policies=set(policies), policy_mapping_fn=NETWORKS[team])
        actor = MultiRLModuleSpec(rl_module_specs=dict.fromkeys(policies, actor))
    return config.rl_module(rl_module_spec=actor)


def _environment(experiment: Experiment, runners: int, worlds: int, evaluating: bool) -> Settings:
    """Return the settings of the environments of one runner, see `agents.rllib_envs`; worlds: that it steps."""
    p = experiment.ppo
    return {
        "task": experiment.build().name,
        "arguments": {**experiment.arguments, "dtype": p.dtype},
        "disturbance": p.disturbance.model_dump(),
        "threads": 1 if runners else p.threads,
        "first": worlds_for("evaluation" if evaluating else "training", p.seed, p.worlds),
        "seed": p.seed,
        "worlds": worlds,
        "stagger": p.stagger and not evaluating,
        "reward_scale": 1.0 if evaluating else p.reward_scale,
    }


def _ppo_settings(p: PpoSettings, batch: int, per_step: int) -> dict[str, Any]:
    """Return the settings of RLlib's PPO; batch: rows per update; per_step: agent-steps that RLlib counts as one."""
    return {
        "train_batch_size_per_learner": batch,
        "minibatch_size": min(p.minibatch, batch),
        "num_epochs": p.epochs,
        "lr": [[0, p.learning_rate], [max(p.steps // per_step, 1), p.learning_rate * 0.1]],
        "gamma": p.gamma,
        "lambda_": p.gae_lambda,
        "clip_param": p.clip,
        "entropy_coeff": p.entropy,
        "vf_loss_coeff": 0.5,  # these four are what Stable-Baselines3's PPO has
        "vf_clip_param": float("inf"),
        "grad_clip": 0.5,
        "use_kl_loss": False,
    }


def start() -> bool:
    """Connect to Ray, or start a local one; return True if this process was not connected before."""
    logging.getLogger("ray.rllib").setLevel(logging.ERROR)  # a page of advice about its API otherwise
    os.environ.setdefault("RAY_worker_niceness", "0")  # with Ray's 15 the learner waits for runners on a busy machine
    return start_ray(ray)


@contextmanager
def built(experiment: Experiment, team: Networks | None, runners: int) -> Iterator[Algorithm]:
    """Build the algorithm for a block, with its runners, on the cluster of RAY_ADDRESS or on a local Ray."""
    config = algorithm_config(experiment, team, runners)
    started = start()
    try:
        if runners > (cores := int(ray.cluster_resources().get("CPU", 1))):
            raise ValueError(f"--runners {runners}: each takes a core, and Ray has {cores}")
        with use_thread_count(experiment.ppo.threads):
            algorithm = config.build_algo()
            try:
                yield algorithm
            finally:
                algorithm.stop()
                shutil.rmtree(algorithm.logdir, ignore_errors=True)  # an empty folder in ~/ray_results
    finally:
        if started:
            ray.shutdown()


# --- weights ----------------------------------------------------------------------------------------------------------


def layers(module: DefaultPPOTorchRLModule) -> dict[str, torch.nn.Linear]:
    """Return the layers of an actor under the names that flockenv.players.policy reads."""
    parts = (module.encoder.actor_encoder, module.pi)
    linear = [layer for part in parts for layer in part.modules() if isinstance(layer, torch.nn.Linear)]
    return {f"policy.{k}" if k < len(linear) - 1 else "action": layer for k, layer in enumerate(linear)}


def tensors_of(module: DefaultPPOTorchRLModule) -> Tensors:
    """Return an actor's weights under the names that flockenv.players.policy reads; the critic is left out."""
    tensors = {f"{name}.{part}": tensor for name, layer in layers(module).items()
               for part, tensor in (("weight", layer.weight), ("bias", layer.bias))}  # fmt: skip
    limit = float(module.pi.log_std_clip_param_const)  # RLlib clips the logarithm when it acts
    tensors["log_std"] = module.pi.log_std.clamp(-limit, limit)
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}


def _write_into(module: DefaultPPOTorchRLModule, tensors: Tensors) -> None:
    """Write an actor's weights into a module of the same sizes."""
    with torch.no_grad():
        module.pi.log_std.copy_(torch.from_numpy(tensors["log_std"]))
        for name, layer in layers(module).items():
            layer.weight.copy_(torch.from_numpy(tensors[f"{name}.weight"]))
            layer.bias.copy_(torch.from_numpy(tensors[f"{name}.bias"]))


def policies_of(algorithm: Algorithm) -> dict[str, Tensors]:
    """Return the weights of all policies of an algorithm, as its learner has them; LearningDiverged if not finite."""
    learner = algorithm.learner_group._learner
    policies = {name: tensors_of(learner.module[name].unwrapped()) for name in learner.module.keys()}  # noqa: SIM118
    for policy in policies.values():
        if bad := [name for name, tensor in policy.items() if not np.isfinite(tensor).all()]:
            raise LearningDiverged(f"weights of the network, {bad[0]}, are not finite after an update")
    return policies


def players_of(algorithm: Algorithm, task: Task, team: Networks | None) -> dict[str, Tensors]:
    """Return the players that an algorithm has learnt, by the ending of their file: ONE, or one of each role.

    Networks of single agents are one player, as they play together only.
    """
    policies = policies_of(algorithm)
    if team == "agent":
        return {ONE: stack_networks([policies[agent] for agent in task.agent_names])}
    return policies


def has_score(task: Task, team: Networks | None) -> bool:
    """Return True unless learners of different roles play against each other: the mean of their returns is no score."""
    return team is None or len({role(agent) for agent in task.agent_names}) == 1


# --- learn ------------------------------------------------------------------------------------------------------------


def train(
    experiment: Experiment, folder: Path, team: Networks | None = None, runners: int = 0
) -> tuple[Run, dict[str, Tensors]]:
    """Train to the end of the budget; return the run, and the last weights of each player, see `players_of`.

    It continues from the folder's checkpoint, if there is one.

    Raises:
        OtherRecipe: the checkpoint has another recipe.
        CheckpointError: it is damaged, or another training holds the folder.
        FloatingPointError: learning or a world diverged; the checkpoint has the last state before that.
    """
    with claim(folder):
        run = load_checkpoint(experiment, folder, state=())
        if run is not None and not _state(folder, run).is_dir():
            raise Damaged(folder, f"{_state(folder, run).name} is missing")
        with built(experiment, team, runners) as algorithm:
            if run is None:
                run = Run(recipe_of(experiment), surroundings(experiment.build(), "ray"))
            else:
                _restore(algorithm, folder, run)
            _remove_states(folder, run)
            with open_log(folder, console) as log, show_progress(new_progress(console)) as progress:
                bar = progress.add_task(run.recipe["task"], total=experiment.ppo.steps, completed=run.steps, score="")
                while run.steps < experiment.ppo.steps:
                    score_text = _iterate(algorithm, experiment, team, run, log, progress.console)
                    _save(algorithm, folder, run)
                    done = min(run.steps, experiment.ppo.steps)
                    progress.update(bar, completed=done, **({"score": score_text} if score_text else {}))
            return run, players_of(algorithm, experiment.build(), team)


def _iterate(
    algorithm: Algorithm, experiment: Experiment, team: Networks | None, run: Run, log: Logger, out: Console
) -> str:
    """Sample and learn once; return the score of the policy if a point of the learning curve is due, otherwise ''."""
    p, task, began, text = experiment.ppo, experiment.build(), time.perf_counter(), ""
    result = algorithm.train()
    run.steps = int(sum(result["env_runners"]["num_agent_steps_sampled_lifetime"].values()))
    players = players_of(algorithm, task, team)
    run.wall += time.perf_counter() - began
    due = run.steps >= min(len(run.curve) * p.evaluate_every, p.steps)
    if due and has_score(task, team):
        (tensors,) = players.values()
        text, line = add_point(run, tensors, score(task, p, tensors))
        log_point(log, run.curve[-1])
        out.print(line)
    _log_iteration(log, run, result)
    return text


def _log_iteration(log: Logger, run: Run, result: dict[str, Any]) -> None:
    """Write a row of the log: steps, time, and what RLlib reports of its episodes and of each network's losses."""
    numbers = {"time/iterations": result["training_iteration"], "time/agent_steps": run.steps, "time/seconds": run.wall}
    episodes = result["env_runners"]
    numbers |= {f"rollout/{name}": episodes.get(name) for name in ("episode_return_mean", "episode_len_mean")}
    for network, losses in result["learners"].items():
        part = "" if network == DEFAULT_MODULE_ID else f"{network}/"
        numbers |= {f"train/{part}{name}": losses.get(name) for name in LOSSES}
    for name, value in numbers.items():
        if value is not None:
            log.record(name, float(value))
    log.dump(run.steps)


def _state(folder: Path, run: Run) -> Path:
    """Return the folder of RLlib's state that belongs to a checkpoint."""
    return folder / f"rllib-{run.steps}"


def _save(algorithm: Algorithm, folder: Path, run: Run) -> None:
    """Write RLlib's state, then the checkpoint that names it, then remove the state before it."""
    with signals.defer_signals():
        algorithm.save_to_path(_state(folder, run))
        save_checkpoint(folder, run)
        _remove_states(folder, run)


def _restore(algorithm: Algorithm, folder: Path, run: Run) -> None:
    """Restore RLlib's state of a checkpoint."""
    state = _state(folder, run)
    try:
        algorithm.restore_from_path(state)
    except Exception as error:  # pickle raises any
        raise Damaged(folder, f"{state.name}: {type(error).__name__}: {' '.join(str(error).split())}") from error


def _remove_states(folder: Path, run: Run) -> None:
    """Remove all states of RLlib that are not the run's, such as that of a process that was killed while writing."""
    for state in folder.glob("rllib-*"):
        if state != _state(folder, run):
            shutil.rmtree(state)


# --- evaluate, export -------------------------------------------------------------------------------------------------


def evaluate(experiment: Experiment, tensors: Tensors, worlds: int) -> Interval:
    """Return the interquartile mean of the return of a policy without noise, as RLlib's own runner plays it.

    The runner plays the episodes one after another: several at once would count more of the short ones.
    """
    task = experiment.build()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*Overriding environment rllib", UserWarning)  # the trained one's
        runner = SingleAgentEnvRunner(config=algorithm_config(experiment, None, 0, evaluating=True))
    _write_into(runner.module, tensors)
    episodes = runner.sample(num_episodes=worlds * task.learners, explore=False)
    runner.stop()
    returns = np.array([episode.get_return() for episode in episodes]).reshape(worlds, task.learners)
    return bootstrap(returns.mean(1))


@app.command()
def main(
    config: Config,
    out: Annotated[
        Path | None, typer.Option(help="default: results/rllib/TASK.safetensors; networks of roles add -ROLE")
    ] = None,
    runs: Annotated[Path, typer.Option(help="folder of checkpoints")] = Path("runs/rllib"),
    runners: Annotated[int, typer.Option(min=0, help="remote env runners; 0: sampling in this process")] = 0,
    team: Annotated[bool, typer.Option("--team", help="learners as PettingZoo agents, see --networks")] = False,
    networks: Annotated[
        Networks | None, typer.Option(help="of a --team: one that all share, one of each role, or of each agent [role]")
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="without the settings that RLlib's PPO does not have")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="start anew instead of from the checkpoint")] = False,
    check: Annotated[int, typer.Option(min=0, help="evaluation episodes that RLlib plays with the policy")] = 0,
    steps: Steps = None,
    worlds: Annotated[int | None, typer.Option(help="worlds, instead of those of the config")] = None,
    seed: TrainingSeed = None,
) -> None:
    """Train policies with RLlib's PPO and export their weights; the same command continues an interrupted training."""
    with one_line_errors():
        changes = {k: v for k, v in (("steps", steps), ("worlds", worlds), ("seed", seed)) if v is not None}
        if networks is not None and not team:
            raise ValueError(f"--networks {networks}: needs --team; without it all learners share one network")
        sharing: Networks | None = (networks or "role") if team else None
        experiment = settings_of(load_experiment(config), sharing, plain, changes)
        name = experiment.build().name
        target = valid_file(str(out or f"results/rllib/{name}.safetensors"), (".safetensors",), True)
        parts = [name, *["team"] * team, *[f"{networks}"] * (networks not in (None, "role"))]
        folder = valid_path(str(runs / "-".join(parts)), "--runs")
        for path in (target, path_in(folder)):
            check_room(path, expected_bytes(experiment))
        if check == 1 or (check and team):
            raise ValueError(f"--check {check}: at least 2 episodes, and not with --team")
        if fresh and folder.exists():
            with claim(folder):
                path_in(folder).unlink(missing_ok=True)
    interrupted = f"interrupted; checkpoints are in {folder}, run the same command to continue"
    with handle_interrupt(interrupted), one_line_errors((ValueError, CheckpointError, OSError)):
        try:
            run, last = train(experiment, folder, sharing, runners)
        except FloatingPointError as error:
            typer.echo(f"error: {error}; the checkpoint before it is in {folder}", err=True)
            raise typer.Exit(DIVERGED) from None
        options = [*["--team"] * team, *[f"--networks {networks}"] * bool(networks), *["--plain"] * plain]
        options += [f"--{name} {value}" for name, value in changes.items()]
        command = " ".join([f"python -m agents.rllib {config.as_posix()}", *options])
        for policy, tensors in ({ONE: run.tensors} if run.tensors else last).items():
            path = target.with_stem(f"{target.stem}-{policy}") if len(last) > 1 else target
            card = {**card_of(run, "RLlib", command), "runners": runners}
            if check:
                found = evaluate(experiment, tensors, check)
                card["rllib_evaluation"] = {"episodes": check, "iqm": found.value, "ci": [found.low, found.high]}
                console.print(f"RLlib's own evaluation: {found} over {check} episodes", highlight=False)
            save_policy(path, tensors, card)
            best = "" if run.best is None else f": mean return {run.best:.3f} on the tuning worlds"
            console.print(f"{path}{best} after {run.steps:,} steps, {run.wall:.0f} s", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    run_program("rllib", app)
