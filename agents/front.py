"""Harm against return: `python -m agents.front configs/studies/price.yaml` plays players at several prices of harm.

All players play the same held-out worlds. A player that cannot observe the price plays once, one that observes it plays
at each price of the study. Returns are those of a price of 1, whatever price a policy was playing at; harm and conduct
are measured (agents/conduct.py). Writes a file and a picture per task into a folder, and a page beside it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from agents.compare import JOBS, folder_of, pick, provenance, split, write_text
from agents.conduct import ConductWorld
from agents.study import HOME, Contender, Setting, Study, contenders_of, settings_of
from agents.study_results import RANDOM, kind_of
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.output_paths import valid_file
from flockenv.evaluation import Episodes, Interval, lead_interval, mean_interval, success_interval
from flockenv.evaluation.report import grid, json_text
from flockenv.jobs import Job, Work, engine_of, run_jobs
from flockenv.jobs.store import Store
from flockenv.players.policy import OtherSlotsError
from flockenv.scene.yaml_io import load
from flockenv.studies.play_jobs import Worlds, episodes_of_bytes, play_job
from flockenv.tasks import TASKS, Task

__all__ = ["app", "front", "markdown"]

PRICE = "price"
SAFE = 0.95
"""Success rate above which the page calls a player safe."""

NOTES = """\
Return: at a price of 1, which is the task's own reward. *Without harm*: the same without the terms that the price
multiplies. *Harmed*: share of worlds in which a learner was harmed, and how many learners of a world. *Frozen*: share
of its time in which a learner stands still (below a tenth of its maximum speed). *Effort*: mean of (force /
max_force)². *Time*: until a learner leaves or the episode ends. *Against rules*: difference of returns to the
hand-written player with the highest return in these worlds. Intervals: 95 %; over training seeds and worlds where a
player has several seeds (their number is beside its name), else over worlds alone: such a player was trained or tuned
once, and its numbers are those of one run."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

Floats = NDArray[np.float64]
Content = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Entry:
    """A player at a price (None: it does not observe it), and the jobs of its members."""

    contender: Contender
    kind: str
    task: Task
    price: float | None
    jobs: Sequence[Job]

    @property
    def name(self) -> str:
        """The player's name, with its price if it observes it."""
        return self.contender.name if self.price is None else f"{self.contender.name} {self.price:g}"


def front(study: Study, tasks: Sequence[str], work: Work) -> dict[str, Content]:
    """Play all tasks with all players of a study; return the content of each task's file.

    Raises:
        ValueError: in one line, a task without a price, or a bad setting or player, before anything is played.
    """
    entries = {task: _entries(study, task) for task in tasks}
    run_jobs([job for of_task in entries.values() for entry in of_task for job in entry.jobs], work)
    return {task: _content(study, of_task, work.store) for task, of_task in entries.items()}


def _entries(study: Study, task: str) -> list[_Entry]:
    if not TASKS[task].priced:
        known = ", ".join(name for name, each in TASKS.items() if each.priced)
        raise ValueError(f"tasks.{task}: has no price of harm; these have one: {known}")
    home, *others = settings_of(study, task)
    wrong = next((setting.name for setting in others if setting.axis != PRICE), None)
    if wrong is not None:
        raise ValueError(f"tasks.{task}: {wrong}: a front varies the price alone")
    found: list[_Entry] = []
    for contender in contenders_of(study, task):
        try:
            found.append(_entry(study, contender, home))
        except OtherSlotsError:
            found += [_entry(study, contender, setting) for setting in others]
    return found


def _entry(study: Study, contender: Contender, setting: Setting) -> _Entry:
    policies = [member.policy(setting.task, study.seed) for member in contender.members]
    within = Worlds(ConductWorld, "conduct")
    jobs = [
        play_job("front", setting.task, member, study.worlds, study.seed, within=within) for member in contender.members
    ]
    price = None if setting.axis == HOME else float(setting.value)
    return _Entry(contender, kind_of(policies[0]), setting.task, price, jobs)


def _content(study: Study, entries: Sequence[_Entry], store: Store) -> Content:
    """Return the content of a task's file, once all jobs are done."""
    played = {entry.name: [store.read(job, episodes_of_bytes) for job in entry.jobs] for entry in entries}
    returns = {entry.name: _returns(entry, played[entry.name]) for entry in entries}
    rules = [entry.name for entry in entries if entry.kind == "rules"]
    best = max(rules, key=lambda name: float(returns[name][0].mean()), default=None)
    task = entries[0].task
    return {
        "task": task.name, "worlds": study.worlds, "seed": study.seed, "best_rules": best,
        "players": {
            entry.name: _point(entry, played[entry.name], returns, best) for entry in entries
        },
        **provenance(),
    }  # fmt: skip


def _returns(entry: _Entry, played: Sequence[Episodes]) -> tuple[Floats, Floats]:
    """Return the returns at a price of 1, and those without terms of harm, (seeds, worlds)."""
    harm = [sum(each.terms[name] for name in entry.task.priced) for each in played]
    without = np.array([each.returns - cost for each, cost in zip(played, harm, strict=True)])
    return without + np.array(harm) / (entry.price or 1.0), without


def _point(
    entry: _Entry, played: Sequence[Episodes], returns: Mapping[str, tuple[Floats, Floats]], best: str | None
) -> Content:
    """Return the numbers of a player at a price, each with its interval."""
    harmed = _rows(played, "harmed")
    own, without = returns[entry.name]
    point: Content = {
        "player": entry.contender.name, "kind": entry.kind, "price": entry.price, "seeds": len(played),
        "return": _numbers(mean_interval(own)),
        "return_without_harm": _numbers(mean_interval(without)),
        "success": _numbers(success_interval(np.array([each.success for each in played]))),
        "worlds_with_harm": _numbers(success_interval(harmed > 0)),
        "harmed": _numbers(mean_interval(harmed)),
        **{name: _numbers(mean_interval(_rows(played, name))) for name in ("frozen", "effort", "time")},
        "metrics": {name: _finite_mean(_rows(played, name)) for name in entry.task.metric_names},
    }  # fmt: skip
    if best is not None and entry.name != best and entry.kind != RANDOM:
        point["against_rules"] = _numbers(lead_interval(own, returns[best][0]))
    if len(played) > 1:
        point["by_seed"] = {
            "return": [float(row.mean()) for row in own],
            "success": [float(each.success.mean()) for each in played],
        }
    return point


def _rows(played: Sequence[Episodes], name: str) -> Floats:
    return np.array([each.metrics[name] for each in played])


def _numbers(interval: Interval) -> list[float]:
    return [float(f"{value:.6g}") for value in (interval.value, interval.low, interval.high)]


def _finite_mean(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(f"{finite.mean():.6g}") if len(finite) else None


# --- the page ---------------------------------------------------------------------------------------------------------


def markdown(study: Study, command: str, contents: Sequence[Content], folder: str) -> str:
    """Return the page as Markdown; command: that makes it; folder: that of the pictures, as links name it."""
    parts = [f"# {study.title}", f"Made by `{command}`, {study.worlds} worlds.", NOTES]
    for content in contents:
        task = content["task"]
        picture = f"![Harm against return in {task}]({folder}/{task}.png)"
        parts += [f"## {task}", _sentence(content), picture, grid(*_table(content))]
    return "\n\n".join(parts) + "\n"


def _sentence(content: Content) -> str:
    """Return which players are safe, and have a return above that of every hand-written player."""
    points, best = content["players"], content["best_rules"]
    better = [f"`{name}`" for name, point in points.items() if point.get("against_rules", [0, 0])[1] > 0]
    safe = [f"`{name}`" for name, point in points.items() if point["success"][0] > SAFE]
    both = [name for name in better if name in safe]
    return (
        f"The hand-written player with the highest return is `{best}`. Ahead of it, with an interval above 0: "
        f"{', '.join(better) or 'none'}. With a success rate above {SAFE:.0%}: {', '.join(safe) or 'none'}. "
        f"Both: {', '.join(both) or 'none'}."
    )


def _table(content: Content) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a task's table: a row per player and price."""
    header = [
        "player", "return", "without harm", "against rules", "success", "worlds with harm", "harmed per world",
        "frozen", "effort", "time, s",
    ]  # fmt: skip
    rows = []
    for name, point in content["players"].items():
        seeds = f" ({point['seeds']} seeds)" if point["seeds"] > 1 else ""
        against = point.get("against_rules")
        rows.append([
            f"`{name}`{seeds}", _text(point["return"]), _text(point["return_without_harm"]),
            "–" if against is None else _text(against), _percent(point["success"]), _percent(point["worlds_with_harm"]),
            f"{point['harmed'][0]:.3g}", f"{point['frozen'][0]:.1%}", f"{point['effort'][0]:.2f}",
            f"{point['time'][0]:.3g}",
        ])  # fmt: skip
    return header, rows


def _text(values: Sequence[float]) -> str:
    value, low, high = values
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def _percent(values: Sequence[float]) -> str:
    value, low, high = (100 * each for each in values)
    return f"{value:.1f} % [{low:.1f}, {high:.1f}]"


# --- the command line -------------------------------------------------------------------------------------------------


@app.command()
def main(
    study: Annotated[Path, typer.Argument(metavar="STUDY.yaml", help="Such as configs/studies/price.yaml.")],
    tasks: Annotated[list[str] | None, typer.Option(help="Tasks of the study, by comma or repeated. [all]")] = None,
    out: Annotated[str, typer.Option(help="Folder for TASK.json and TASK.png; the page is OUT.md.")] = "results/fronts",
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
    debug: Debug = False,
) -> None:
    """Play players at several prices of harm, and draw harm against return."""
    with report_errors("front", STOPPED, debug), end_of_shard():
        plan = load(study, Study)
        names = pick("--tasks", split(tasks) or list(plan.tasks), plan.tasks)
        folder = folder_of(out, [f"{name}.{end}" for name in names for end in ("json", "png")])
        page = valid_file(f"{folder}.md", (".md",), force=True)
        with job_bar() as progress:
            work = Work(Store(folder / JOBS), engine_of(engine, processes), fresh, progress, shard_of(shard))
            contents = front(plan, names, work)
        some = f" --tasks {','.join(names)}" if names != list(plan.tasks) else ""
        _write(page, plan, f"python -m agents.front {study.as_posix()} --out {out}{some}", list(contents.values()))
    typer.echo(f"{page}: written")


def _write(page: Path, study: Study, command: str, contents: Sequence[Content]) -> None:
    """Write the page, and the file and picture of each task in the folder of the same name, all or none."""
    from agents.front_chart import draw_front

    folder = page.with_suffix("").name
    writers: dict[str, Callable[[Path], None]] = {}
    for content in contents:
        writers[f"{folder}/{content['task']}.json"] = functools.partial(write_text, text=json_text(content))
        writers[f"{folder}/{content['task']}.png"] = functools.partial(draw_front, content=content)
    writers[page.name] = functools.partial(write_text, text=markdown(study, command, contents, folder))
    write_all_or_none(page.parent, writers)


if __name__ == "__main__":
    run_program("front", app, STOPPED)
