"""Best response: one agent deviates from all others. `python -m agents.best_response configs/training/school.yaml`.

In the comparison all agents of a world play one policy. Here one agent of each world plays one policy, and all others
another (agents/invasion.py). With --out, writes a file and a heat map per task, and a page beside the folder.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from agents.compare import JOBS, folder_of, provenance, split, write_text
from agents.experiment import load_experiment
from agents.invasion import Payoffs, invade, jobs_of
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug, Delay, Dropped, Noise, Reach, Seen, TrustPickle
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.output_paths import valid_file
from flockenv.envs.disturbance import Disturbance
from flockenv.evaluation import WORLDS_PER_SEED, Interval
from flockenv.evaluation.report import grid, json_text
from flockenv.jobs import Store, Work, engine_of, run_jobs
from flockenv.studies.play_jobs import Player, players_in_order, players_of, usual_players
from flockenv.tasks import Task

__all__ = ["app", "content_of", "markdown", "table_of"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True)

WORLDS = 256

NOTES = """\
One agent of each world plays the player of the row, all others that of the column, in the same held-out worlds; each
learner of a world is that agent equally often. A cell has the mean return of the one agent and, in brackets, what it
gains over playing as the others do, with its 95 % bootstrap interval over worlds. The picture is coloured by that gain:
a blue cell is a player that does better among the column's than they do themselves. A player of several seeds is the
one that ships, so the intervals do not contain the luck of training or of the search."""


def table_of(payoffs: Payoffs) -> Table:
    """Return the payoffs: a row per policy of the one agent, a column per policy of all others."""
    table = Table("", *payoffs.players)
    for one in payoffs.players:
        table.add_row(one, *(str(payoffs.mean(one, others)) for others in payoffs.players))
    return table


def content_of(payoffs: Payoffs) -> dict[str, Any]:
    """Return the payoffs as plain data: means and gains with their intervals, and the verdict on each pair."""
    pairs = [(one, others) for one in payoffs.players for others in payoffs.players]
    worlds = next(iter(payoffs.of.values()))
    return {
        "task": payoffs.task, "worlds": worlds.worlds, "first_seed": worlds.seed, "players": list(payoffs.players),
        **({"disturbance": payoffs.disturbance.model_dump()} if payoffs.disturbance else {}),
        "mean": {f"{one} among {others}": _numbers(payoffs.mean(one, others)) for one, others in pairs},
        "gain": {
            f"{one} among {others}": _numbers(payoffs.gain(one, others)) for one, others in pairs if one != others
        },
        "verdicts": [payoffs.verdict(*pair) for pair in combinations(payoffs.players, 2)],
        **provenance(),
    }  # fmt: skip


def _numbers(interval: Interval) -> list[float]:
    return [float(f"{value:.6g}") for value in (interval.value, interval.low, interval.high)]


def markdown(contents: Sequence[Mapping[str, Any]], command: str, folder: str) -> str:
    """Return the page: per task the picture, the table, and a verdict per pair; folder: of the pictures."""
    worlds = ", ".join(dict.fromkeys(str(each["worlds"]) for each in contents))
    parts = ["# What one agent gains among others", f"Made by `{command}`, {worlds} worlds per cell.", NOTES]
    for each in contents:
        names = each["players"]
        rows = [[f"`{one}`", *(_cell(each, one, others) for others in names)] for one in names]
        parts += [
            f"## {each['task']}",
            f"![Gain of one agent in {each['task']}]({folder}/{each['task']}.png)",
            grid(["one agent", *(f"among `{name}`" for name in names)], rows),
            "\n".join(f"* {line}" for line in each["verdicts"]),
        ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _cell(content: Mapping[str, Any], one: str, others: str) -> str:
    mean = content["mean"][f"{one} among {others}"][0]
    if one == others:
        return f"{mean:.3g}"
    value, low, high = content["gain"][f"{one} among {others}"]
    return f"{mean:.3g} ({value:+.3g} [{low:.3g}, {high:.3g}])"


@app.command()
def main(
    configs: Annotated[list[Path], typer.Argument(help="experiments, such as configs/training/school.yaml")],
    players: Annotated[
        list[str] | None,
        typer.Option(help="players, by comma or repeated [rules, ppo, and others written for the task]"),
    ] = None,
    worlds: Annotated[int, typer.Option(min=2, max=WORLDS_PER_SEED, help="number of evaluation worlds")] = WORLDS,
    seed: Annotated[int, typer.Option(min=0, max=999, help="block of evaluation worlds")] = 0,
    noise: Noise = 0.0,
    delay: Delay = 0,
    dropped: Dropped = 0.0,
    reach: Reach = None,
    seen: Seen = None,
    out: Annotated[
        str | None, typer.Option(help="folder for TASK.json and TASK.png; the page is OUT.md [only printed]")
    ] = None,
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
    trust_pickle: TrustPickle = False,
    debug: Debug = False,
) -> None:
    """Measure whether one agent gains by a policy other than that of all others in its world."""
    with report_errors("best_response", STOPPED, debug), end_of_shard(), TemporaryDirectory() as temporary:
        tasks = [load_experiment(config).build() for config in configs]
        disturbance = Disturbance(noise=noise, delay=delay, dropped=dropped, range=reach, seen=seen)
        fields = _fields(tasks, split(players), seed, trust_pickle)
        if shard is not None and out is None:
            raise ValueError("--shard: needs --out, where the records of all shares are stored")
        names = [f"{task.name}.{end}" for task in tasks for end in ("json", "png")]
        folder = Path(temporary) if out is None else folder_of(out, names)
        page = None if out is None else valid_file(f"{folder}.md", (".md",), force=True)
        runner, part = engine_of(engine, processes, small=worlds < WORLDS), shard_of(shard)
        with job_bar(lines=out is not None) as progress:
            work = Work(Store(folder / JOBS), runner, fresh, progress, part)
            jobs = [jobs_of(task, field, worlds, seed, trust_pickle, disturbance) for task, field in fields]
            run_jobs([job for of_task in jobs for job in of_task.values()], work)
        collect = Work(work.store, runner)
        found = [invade(task, field, worlds, seed, trust_pickle, collect, disturbance) for task, field in fields]
        if page is not None:
            command = f"python -m agents.best_response {' '.join(map(str, configs))} --out {out}"
            options = [f"--players {','.join(split(players))}"] if players else []
            options += [f"--{name} {value}" for name, value in disturbance.model_dump().items() if value]
            _write(page, found, " ".join([command, *options]))
    _show(found)
    if page is not None:
        typer.echo(f"{page}: written")


def _fields(
    tasks: Sequence[Task], names: Sequence[str], seed: int, trust_pickle: bool
) -> list[tuple[Task, list[Player]]]:
    """Return each task with its players; bad ones raise before any episode."""
    specs = names or [name for name in usual_players(tasks) if name not in ("random", "textbook")]
    of_task = players_of(tasks, players_in_order(specs))
    for task in tasks:
        for player in of_task[task.name]:
            for phrase in getattr(player.policy(task, seed, trust_pickle), "differences", ()):
                console.print(f"{task.name}: {player.name}: {phrase}", markup=False)
    return [(task, of_task[task.name]) for task in tasks]


def _write(page: Path, found: Sequence[Payoffs], command: str) -> None:
    """Write the page, and the file and picture of each task in the folder of the same name, all or none."""
    from agents.payoff_chart import draw_payoffs

    folder, contents = page.with_suffix("").name, [content_of(payoffs) for payoffs in found]
    writers: dict[str, Callable[[Path], None]] = {}
    for each in contents:
        writers[f"{folder}/{each['task']}.json"] = functools.partial(write_text, text=json_text(each))
        writers[f"{folder}/{each['task']}.png"] = functools.partial(draw_payoffs, content=each)
    writers[page.name] = functools.partial(write_text, text=markdown(contents, command, folder))
    write_all_or_none(page.parent, writers)


def _show(found: Sequence[Payoffs]) -> None:
    """Print the table of each task, and a verdict for each pair."""
    out = Console(highlight=False)
    if not out.is_terminal:
        out = Console(highlight=False, width=200)  # a pipe has no width
    for payoffs in found:
        out.print(f"{payoffs.task}: mean return of one agent that plays the row, among others that play the column")
        out.print(table_of(payoffs))
        for pair in combinations(payoffs.players, 2):
            out.print(payoffs.verdict(*pair), markup=False)


if __name__ == "__main__":
    run_program("best_response", app, STOPPED)
