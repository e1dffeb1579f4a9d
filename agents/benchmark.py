"""One score for a player: `python -m agents.benchmark my_player.py` plays all tasks, at home and in other settings.

The score is 0 for random actions and 1 for tuned rules (agents/scores.py). *Home* is over the tasks as configured,
*robust* over all settings of a study, without those of other integrators. Random actions and tuned rules play the same
worlds. Writes an entry, NAME.json, into a folder, and the table of all its entries beside it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from agents.compare import JOBS, ROOT, folder_of, provenance, write_text
from agents.scores import THRESHOLDS, Aggregate, aggregate
from agents.study import INTEGRATOR, Study, contenders_of, settings_of
from agents.study_results import RANDOM, SettingResults, TaskResults, kind_of, read_task
from agents.sweep import plan_digest, sweep
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes, ShardText, end_of_shard, shard_of
from flockenv.cli.options import Debug
from flockenv.cli.terminal import job_bar, report_errors, run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import printable
from flockenv.core.output_paths import valid_file
from flockenv.evaluation import Interval, lead_interval
from flockenv.evaluation.report import grid, json_text
from flockenv.jobs import Store, Work, engine_of
from flockenv.players import known_name
from flockenv.scene.yaml_io import load
from flockenv.studies.play_jobs import NAME

__all__ = ["app", "entry_of", "plan_of", "table"]

STUDY = ROOT / "configs" / "studies" / "robustness.yaml"
LEAST = 0.5
"""A player below this home score is marked: it does not solve the tasks."""

DIGITS = 6
"""Significant digits of returns: with few, those of players that are nearly alike would be ties."""
GOOD = 0.9
"""Score, one of THRESHOLDS, for the share of settings in the table: interquartile means hide the worst settings."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def entry_of(
    name: str, spec: str, study: str, tasks: Sequence[TaskResults], contents: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the entry of a player as plain data: its scores, and what they were computed from.

    study: digest of the study, as entries of different studies are not comparable.
    """
    home = {results.task: results.settings[0] for results in tasks}
    everywhere = {
        f"{results.task}/{each.name}": each
        for results in tasks for each in results.settings
        if name in each.scores and _has_scale(each)
    }  # fmt: skip
    left_out = sum(len(results.settings) for results in tasks) - len(everywhere)
    digests = {
        task: [setting["players"][name].get("digest") for setting in content["settings"]]
        for task, content in contents.items()
    }
    players = [setting["players"][name] for content in contents.values() for setting in content["settings"]]
    known = [player["microseconds"] for player in players if "microseconds" in player]
    return {
        "player": name,
        "spec": spec,
        "study": study,
        "kind": next(iter(home.values())).scores[name].kind,
        "seeds": min(len(setting.scores[name].returns) for setting in home.values()),
        "home": _plain(aggregate(home, name)),
        "robust": _plain(aggregate(everywhere, name)),
        "settings": len(everywhere),
        "settings_left_out": left_out,
        "microseconds_per_decision": sorted(known)[len(known) // 2] if known else None,
        "worlds": digests,
        **provenance(),
    }


def _has_scale(setting: SettingResults) -> bool:
    """Return True if rules are better than random by more than the interval, so that a score has a scale."""
    return lead_interval(setting.scores["rules"].returns, setting.scores[RANDOM].returns).low > 0


def _plain(found: Aggregate) -> dict[str, Any]:
    return {
        "score": _interval(found.score),
        "profile": dict(zip(map(str, THRESHOLDS), found.profile, strict=True)),
        "improvement": _interval(found.improvement),
        "by_task": dict(found.by_task),
    }


def _interval(interval: Interval) -> list[float]:
    return [round(value, 4) for value in (interval.value, interval.low, interval.high)]


def table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of all entries, the best home score first, as Markdown."""
    rows = []
    for entry in sorted(entries, key=lambda each: (-each["home"]["score"][0], each["player"])):
        marked = "" if entry["home"]["score"][0] >= LEAST else " (does not solve the tasks)"
        cost = entry["microseconds_per_decision"]
        rows.append(
            [
                f"`{entry['player']}`{marked}", entry["kind"], str(entry["seeds"]),
                *(_text(entry[where]["score"]) for where in ("home", "robust")),
                f"{entry['settings']} of {entry['settings'] + entry['settings_left_out']}",
                f"{entry['robust']['profile'][str(GOOD)]:.0%}", _text(entry["home"]["improvement"]),
                "–" if cost is None else f"{cost:.2g}",
            ]
        )  # fmt: skip
    header = [
        "player", "kind", "seeds", "home", "robust", "settings", f"above {GOOD:g}", "higher than rules",
        "µs per decision",
    ]  # fmt: skip
    return "\n\n".join([TITLE, grid(header, rows), NOTES]) + "\n"


TITLE = "# Leaderboard"
NOTES = f"""\
Score: 0 = random actions, 1 = tuned rules; interquartile mean over tasks (*home*), or over all settings of the
study but those of other integrators (*robust*), with the 95 % stratified bootstrap interval over training seeds and
worlds.
An interquartile mean leaves out the worst quarter: *above {GOOD:g}* is the share of settings with such a score.
*Higher than rules*: probability of a higher return than tuned rules in the same world. A player below {LEAST:g} does
not solve the tasks. With one seed, the interval does not contain the luck of training. `python -m agents.benchmark
PLAYER --out docs/leaderboard` adds an entry; its JSON file has the scores of each task, the performance profile, and
digests of settings, worlds and player."""


def _text(values: Sequence[float]) -> str:
    value, low, high = values
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def plan_of(path: Path) -> Study:
    """Return the settings to play: those of a study but for other integrators, which are slow to compile."""
    plan: Study = load(path, Study)
    return plan.model_copy(update={"everywhere": {a: each for a, each in plan.everywhere.items() if a != INTEGRATOR}})


def _check_player(plan: Study, task: str, name: str) -> None:
    """Raise ValueError, in one line, unless the player can play a task at home."""
    home = settings_of(plan, task)[0]
    contender = next((each for each in contenders_of(plan, task) if each.name == name), None)
    if contender is None:
        raise ValueError(f"player {name!r} does not play {task}; a score is over all tasks of the study")
    for member in contender.members:
        kind_of(member.policy(home.task, plan.seed))


def _other_entries(folder: Path, name: str, study: Study) -> list[dict[str, Any]]:
    """Return the entries of other players of the same study; raise ValueError for a file that is no entry."""
    found = []
    for path in sorted(folder.glob("*.json")):
        try:
            entry = json.loads(path.read_text(encoding="utf-8"))
            same = entry["study"] == plan_digest(study)
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"{path}: is no entry of agents.benchmark; move it elsewhere") from None
        if same and entry["player"] != name:
            found.append(entry)
    return found


def _name_of(player: str) -> str:
    """Return the name of a player in the table: ppo@all of ppo@*; that of a file without its ending."""
    if known_name(player):
        return player.replace("*", "all")
    return Path(player.replace("{task}", "").rstrip("*")).stem


@app.command()
def main(
    player: Annotated[
        str,
        typer.Argument(help="A known name, also ppo@3 or ppo@*; a .py, a .safetensors, or files with {task} and *."),
    ],
    name: Annotated[str | None, typer.Option(help="Name in the table. [the file's name]")] = None,
    study: Annotated[Path, typer.Option(help="Settings to play.")] = STUDY,
    out: Annotated[str, typer.Option(help="Folder of entries; the table is OUT.md.")] = "results/leaderboard",
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
    shard: ShardText = None,
    debug: Debug = False,
) -> None:
    """Play all tasks and settings with a player, and write its scores."""
    with report_errors("benchmark", STOPPED, debug), end_of_shard():
        called = name or _name_of(player)
        if not NAME.fullmatch(called) or (called in (RANDOM, "rules") and called != player):
            raise ValueError(f"--name {printable(called)}: a name is up to 40 letters, digits and _ . @ + -")
        settings = plan_of(study)
        plan = settings.model_copy(update={"players": {RANDOM: RANDOM, "rules": "rules", called: player}})
        folder = folder_of(out, (f"{called}.json",))
        page = valid_file(f"{folder}.md", (".md",), force=True)
        for task in plan.tasks:
            _check_player(plan, task, called)
        others = _other_entries(folder, called, settings)
        with job_bar(lines=False) as progress:
            work = Work(Store(folder / JOBS), engine_of(engine, processes), fresh, progress, shard_of(shard))
            contents = sweep(plan, list(plan.tasks), work, choose=False, digits=DIGITS)
        results = [read_task(content) for content in contents.values()]
        entry = entry_of(called, player, plan_digest(settings), results, contents)
        text = json_text(entry)
        write_all_or_none(page.parent, {
            f"{folder.name}/{called}.json": lambda path: write_text(path, text),
            page.name: lambda path: write_text(path, table([*others, entry])),
        })  # fmt: skip
    home, robust = (_text(entry[where]["score"]) for where in ("home", "robust"))
    typer.echo(f"{called}: home {home}, robust {robust} (0 = random, 1 = tuned rules)")
    typer.echo(f"{folder / called}.json and {page}: written")


if __name__ == "__main__":
    run_program("benchmark", app, STOPPED)
