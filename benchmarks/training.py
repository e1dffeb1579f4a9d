"""Where the time of PPO goes, on real tasks: `python -m benchmarks.training`.

The tasks and settings of configs/training/*.yaml, built as agents.ppo builds them, and a few settings beside them,
among these what Stable-Baselines3 has by default. Contestants take turns of some rollouts and updates each; the clock
is read around env.step, the policy's forward pass, the whole rollout, and, in the update, the loss, the gradient and
the optimizer. What is left is Stable-Baselines3's own Python: copies, batches, clipping of gradients. Before that, in
processes of their own: a forward pass and a step of many worlds, by how long torch's threads spin (agents/__init__.py).
"""

from __future__ import annotations

import statistics
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, process_time
from typing import Annotated, Any

import typer

from agents.experiment import CONFIGS, PpoSettings, load_experiment
from benchmarks.floors import Machine, machine, of_decisions, of_learning
from benchmarks.measure import Bench, Contestant, Numbers, Out, Quick, Result, Rounds, Sample, command_line, number
from benchmarks.peers import PeerError, start_script
from flockenv.tasks import Task

__all__ = ["EXPERIMENTS", "Learning", "settings"]

EXPERIMENTS = ("pursuit", "obstacles", "flock")
SECONDS, QUICK_SECONDS = 4.0, 1.0  # s, a turn lasts at least
ROUNDS, QUICK_ROUNDS = 3, 1
SPINS = ("300000", "10000", "0")  # rounds: libgomp's own, what agents asks for, none
MOST_THREADS = 2  # that floors are measured for
SB3_ROWS = 8  # environments, a usual number


def settings(p: PpoSettings, learners: int) -> Iterator[tuple[str, PpoSettings]]:
    """Yield what is compared, by name."""
    four = {"epochs": 4}
    yield "as configured", p
    yield "1 epoch", p.model_copy(update={"epochs": 1})
    yield "4 epochs", p.model_copy(update=four)
    other = "tanh" if p.activation == "relu" else "relu"
    yield f"4 epochs, {other}", p.model_copy(update={**four, "activation": other})
    count = 1 if p.threads > 1 else 2
    yield f"4 epochs, {_threads_text(count)}", p.model_copy(update={**four, "threads": count})
    yield "4 epochs, minibatch x 4", p.model_copy(update={**four, "minibatch": 4 * p.minibatch})
    wide = {"worlds": 2 * p.worlds, "rollout": max(1, p.rollout // 2)}
    yield "4 epochs, rows x 2, rollout / 2", p.model_copy(update={**four, **wide})
    yield "SB3's defaults", PpoSettings(
        worlds=max(1, SB3_ROWS // learners), rollout=2048, minibatch=64, epochs=10, learning_rate=3e-4,
        activation="tanh", log_std=0.0, threads=p.threads,
    )  # fmt: skip


def _threads_text(threads: int) -> str:
    """Return a number of threads in words."""
    return "one thread" if threads == 1 else f"{threads} threads"


# --- one model, with a clock --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Learning(Contestant):
    """A model that rolls out and updates, again and again, when it is its turn."""

    model: Any = None
    threads: int = 1  # of torch and of the worlds
    seconds: float = SECONDS
    spent: dict[str, float] = field(default_factory=lambda: defaultdict(float))  # s, by what

    def warm(self, seconds: float) -> int:
        """Roll out and update once; a call is then a turn, however many rollouts it takes."""
        self._learn_once()
        self.spent.clear()
        return 1

    def sample(self, calls: int) -> Sample:
        """Roll out and update until the turn is over."""
        cpu, began, steps = process_time(), perf_counter(), 0.0
        while (took := perf_counter() - began) < self.seconds or not steps:
            steps += self._learn_once()
        self.spent["all"] += took
        return Sample(steps, took, process_time() - cpu)

    def _learn_once(self) -> float:
        """Run one rollout and one update; return the number of agent-steps."""
        from agents.training import use_thread_count

        before = self.model.num_timesteps
        steps = self.model.n_steps * self.model.n_envs
        with use_thread_count(self.threads), _clock_parts(self.model, self.spent):
            self.model.learn(steps, reset_num_timesteps=not before, log_interval=None)
        return float(steps)


@contextmanager
def _clock_parts(model: Any, spent: dict[str, float]) -> Iterator[None]:
    """Time what a model does, in seconds added to `spent`, by name; nothing of it stays in place."""
    import torch

    policy = model.policy
    places = [
        (model, "collect_rollouts", "rollout"), (model, "train", "update"), (model.env, "step", "env"),
        (policy, "forward", "forward"), (policy, "predict_values", "forward"), (policy, "evaluate_actions", "loss"),
        (torch.Tensor, "backward", "gradient"), (policy.optimizer, "step", "optimizer"),
    ]  # fmt: skip
    kept = [(owner, name, vars(owner).get(name)) for owner, name, _ in places]
    for owner, name, what in places:
        setattr(owner, name, _with_clock(getattr(owner, name), what, spent))
    try:
        yield
    finally:
        for owner, name, before in kept:
            if before is None:
                delattr(owner, name)
            else:
                setattr(owner, name, before)


def _with_clock(call: Callable[..., Any], what: str, spent: dict[str, float]) -> Callable[..., Any]:
    """Return the same callable with a clock around it."""

    def timed_call(*arguments: Any, **named: Any) -> Any:
        began = perf_counter()
        try:
            return call(*arguments, **named)
        finally:
            spent[what] += perf_counter() - began

    return timed_call


# --- the races ------------------------------------------------------------------------------------------------------


def _race(bench: Bench, name: str, seconds: float, most: Machine | None) -> None:
    """Race the settings of one task."""
    from agents.ppo import build

    experiment = load_experiment(CONFIGS / f"{name}.yaml")
    task: Task = experiment.build()
    contestants = []
    for title, p in settings(experiment.ppo, task.learners):
        model = build(task, p)
        work = of_learning(model.policy, p.epochs, of_decisions(task, p.worlds))
        floor = most.floor(work, p.threads) if most and p.threads <= MOST_THREADS else None
        contestants.append(Learning(title, lambda: None, 0, floor, _setting_text(p, task), model, p.threads, seconds))
    _note_shares(bench, name, bench.race(f"PPO on {name}", contestants, baseline="as configured"), contestants)


def _race_spins(bench: Bench, seconds: float) -> None:
    """Race forward passes and steps of Flock on two threads, by how long torch's threads spin before they sleep."""
    script, case = "run_ours.py", "flock_after_a_pass"
    try:
        with ExitStack() as stack:
            contestants = []
            for spins in SPINS:
                environment = {"GOMP_SPINCOUNT": spins}
                side = start_script(f"{spins} rounds", Path(sys.executable), script, case, 2, seconds, environment)
                contestants.append(stack.enter_context(side))
            title = "a forward pass and a step of Flock, 2 threads, by how long torch's spin"
            bench.race(title, contestants, baseline=contestants[0].name)
    except PeerError as error:
        bench.note(str(error))


def _setting_text(p: PpoSettings, task: Task) -> str:
    """Return a setting in words."""
    rows = p.worlds * task.learners
    return (
        f"{rows} rows x {p.rollout}, minibatch {p.minibatch}, {p.epochs} epochs, {p.activation} "
        f"{'x'.join(map(str, p.hidden))}, torch and worlds on {_threads_text(p.threads)}"
    )


def _note_shares(bench: Bench, name: str, results: list[Result], contestants: list[Learning]) -> None:
    """Say what share of the time each thing took."""
    for result, contestant in zip(results, contestants, strict=False):
        s = contestant.spent
        if not s["all"]:
            continue
        parts: Numbers = {
            "env.step": s["env"], "policy forward": s["forward"],
            "rest of the rollout": s["rollout"] - s["env"] - s["forward"],
            "loss": s["loss"], "gradient": s["gradient"], "optimizer": s["optimizer"],
            "rest of the update": s["update"] - s["loss"] - s["gradient"] - s["optimizer"],
            "neither": s["all"] - s["rollout"] - s["update"],
        }  # fmt: skip
        shares = {what: value / s["all"] for what, value in parts.items()}
        bench.extra.setdefault("shares", {}).setdefault(name, {})[result.name] = shares
        text = ", ".join(f"{what} {share:.1%}" for what, share in shares.items() if share > 0.0005)
        bench.note(f"{name}, {result.name}: rollout {s['rollout'] / s['all']:.0%} of the time; {text}.")


def _note_summary(bench: Bench) -> None:
    """Say how far five minutes go, and what SB3's defaults would come to."""
    for name in EXPERIMENTS:
        mine = {r.name: r for r in bench.results if r.race == f"PPO on {name}"}
        if "as configured" in mine and "SB3's defaults" in mine:
            ratio = statistics.median(
                a / b for a, b in zip(mine["as configured"].rates, mine["SB3's defaults"].rates, strict=False)
            )
            reach = ", ".join(f"{key} {number(300 * r.rate / 1e6)} M" for key, r in mine.items())
            bench.note(f"{name}, agent-steps in five minutes: {reach}; as configured {number(ratio)} times SB3's.")


def main(
    only: Annotated[str, typer.Option(help=f"One task: {', '.join(EXPERIMENTS)}.")] = "",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Least seconds of a turn. [4; quick: 1]")] = None,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure PPO on real tasks: rates end to end, and where the time goes."""
    if only and only not in EXPERIMENTS:
        raise typer.BadParameter(f"--only {only!r}: unknown; allowed: {', '.join(EXPERIMENTS)}")
    turns = rounds or (QUICK_ROUNDS if quick else ROUNDS)
    with Bench("training", quick, turns, out, unit="k agent-steps/s", scale=1e3) as bench:
        turn, most = seconds or (QUICK_SECONDS if quick else SECONDS), machine(bench, *range(1, MOST_THREADS + 1))
        if not only:
            _race_spins(bench, turn)
        for name in EXPERIMENTS:
            if only in ("", name) and Path(CONFIGS / f"{name}.yaml").exists():
                _race(bench, name, turn, most)
        _note_summary(bench)
        bench.note("End to end: rollouts and updates. Torch and the worlds use as many threads as the setting says.")


if __name__ == "__main__":
    command_line(main)()
