"""Search for better parameters of a hand-written player: `python -m agents.tune configs/training/pursuit.yaml`.

`--player orca` tunes another one than the rules, `--seeds 0-9` searches with several search seeds. Each search's
outcome is a file in the folder of `--records`; the search with the median score on the common tuning worlds goes into
flockenv/players/tuned/TASK.json, with the scores of all. agents/search.py has the algorithm.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from agents.experiment import Experiment, load_experiment, one_line_errors, seeds_of
from agents.options import Config
from agents.search import Found, median_of, search
from flockenv.cli.jobs import STOPPED, EngineName, Fresh, Processes
from flockenv.cli.terminal import job_bar, run_program
from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.core.errors import nearest, printable
from flockenv.core.output_paths import check_room, valid_file, valid_path
from flockenv.evaluation.report import json_text, rounded
from flockenv.jobs import Store, Work, engine_of
from flockenv.players import PUBLISHED
from flockenv.players.rules import PLAYERS, TUNED, read_tuned
from flockenv.players.rules.parameter import beyond
from flockenv.tasks import Task

__all__ = ["app", "content_of", "found_of", "write"]

DIGITS = 5
"""Significant digits of a stored curve."""

ROOM = 2**18
"""Bytes: more than a file takes."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)


def found_of(ships: Found, found: Sequence[Found]) -> dict[str, Any]:
    """Return how the parameters that ship were found: cost, scores on the common tuning worlds, and all searches.

    Keys: agent_steps, tuning_mean, tuning_success, textbook_mean, textbook_success, tuning_worlds, at_bounds, of the
    search that ships; seed, its search seed; seeds, the number of searches; scores, of each search seed, and their
    lowest and highest; searches, of each search seed its parameters, success, cost, and curve: agent-steps, seconds,
    mean return and success of the mean of its distribution.
    """
    kept = (
        "agent_steps", "tuning_mean", "tuning_success", "textbook_mean", "textbook_success", "tuning_worlds",
        "at_bounds", "seed",
    )  # fmt: skip
    scores = {str(each.seed): each.tuning_mean for each in found}
    return {
        **{key: getattr(ships, key) for key in kept},
        "seeds": len(found),
        "scores": scores,
        "lowest": min(scores.values()),
        "highest": max(scores.values()),
        "searches": {str(each.seed): _search_of(each) for each in found},
    }


def _search_of(found: Found) -> dict[str, Any]:
    """Return what is kept of one search, with few digits except for the parameters."""
    curve = {
        key: [rounded(point[key], DIGITS) for point in found.curve] for key in ("steps", "seconds", "mean", "success")
    }
    about = {"agent_steps": found.agent_steps, "seconds": found.seconds, "curve": curve}
    return {"parameters": found.parameters, "success": rounded(found.tuning_success, DIGITS), **about}


def write(path: Path, task: str, player: str, parameters: Mapping[str, float], found: Mapping[str, Any]) -> None:
    """Write a player's parameters into the file of a task, which keeps those of other players."""
    _write_json(path, content_of(task, {**read_tuned(path), player: {"parameters": parameters, "found": found}}))


def content_of(task: str, players: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a task's file of tuned parameters, with its players in the order of the tables."""
    return {"task": task, "players": {name: players[name] for name in PLAYERS if name in players}}


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file completely or not at all."""
    with new_folder(path.parent), replace_file(path) as file:
        file.write(json_text(content).encode())


def _check_player(name: str, task: Task) -> None:
    """Raise ValueError, with the nearest name, unless a task has a hand-written player that is tuned by that name."""
    allowed = [each for each in PUBLISHED if task.name in PLAYERS[each]]
    if name not in allowed:
        raise ValueError(
            f"--player {printable(name)}: unknown{nearest(name[:200], allowed)}; for {task.name} allowed: "
            f"{', '.join(allowed)}"
        )


def _show(found: Sequence[Found], target: Path) -> None:
    """Print a line for each search, which parameters lie on a bound, and which search ships."""
    for each in found:
        console.print(
            f"{each.task}, {each.player}, seed {each.seed}: mean return {each.textbook_mean:.3f} (textbook) -> "
            f"{each.tuning_mean:.3f}, success {each.textbook_success:.0%} -> {each.tuning_success:.0%}, "
            f"{each.agent_steps:,} agent-steps, {each.seconds:.0f} s"
        )
    ships = median_of(found)
    if ships.at_bounds:
        console.print(f"on a bound of its range: {', '.join(_bound(ships, name) for name in ships.at_bounds)}")
    console.print(f"{target}: seed {ships.seed}, the median of {len(found)}: {json.dumps(ships.parameters)}")


def _bound(found: Found, name: str) -> str:
    """Return a parameter at a bound, and why that bound is natural, if it is."""
    end = found.at_bounds[name]
    more = beyond(PLAYERS[found.player][found.task][1], name, end)
    return f"{name} = {end:g} ({f'natural: {more}' if more else 'a wider range may have a better value'})"


@app.command()
def main(
    config: Config,
    player: Annotated[
        str, typer.Option(help="Hand-written player of the task: rules, orca, heuristics or queueing.")
    ] = "rules",
    seeds: Annotated[
        str | None, typer.Option(help="Search seeds, 0-9 or 0,3; the median search is written. [that of the config]")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="default: flockenv/players/tuned/TASK.json")] = None,
    results: Annotated[Path, typer.Option("--records", help="Folder for the outcome of each search.")] = Path(
        "results/tune"
    ),
    jobs: Annotated[Path, typer.Option(help="Folder for the records of jobs.")] = Path("results/jobs"),
    engine: EngineName = "local",
    processes: Processes = None,
    fresh: Fresh = False,
) -> None:
    """Search a hand-written player's parameters and write what was found."""
    with one_line_errors():
        experiment = load_experiment(config)
        task = experiment.build()
        _check_player(player, task)
        experiment.ppo.disturbance.check(task)
        numbers = [experiment.search.seed] if seeds is None else seeds_of(seeds)
        target = TUNED / f"{task.name}.json" if out is None else valid_file(str(out), (".json",), force=True)
        folder = valid_path(str(results), "--records")
        read_tuned(target)
        for path in (target, folder / "record"):
            check_room(path, ROOM)
        store, runner = Store(valid_path(str(jobs), "--jobs")), engine_of(engine, processes)
    with one_line_errors(), job_bar("compiling and playing", lines=False) as progress:
        found = search(experiment, player, numbers, Work(store, runner, fresh, progress))
    _show(found, target)
    with one_line_errors():
        _write_all(experiment, found, folder, target)


def _write_all(experiment: Experiment, found: Sequence[Found], folder: Path, target: Path) -> None:
    """Write the outcome of each search, and the median search as the tuned parameters."""
    settings, disturbance = experiment.search.model_dump(mode="json"), experiment.ppo.disturbance
    within = {"disturbance": disturbance.model_dump(mode="json")} if disturbance else {}
    for each in found:
        path = folder / f"{each.task}-{each.player}-seed-{each.seed}.json"
        _write_json(path, {**asdict(each), "settings": settings, **within})
    ships = median_of(found)
    write(target, ships.task, ships.player, ships.parameters, {**found_of(ships, found), **within})


if __name__ == "__main__":
    run_program("tune", app, STOPPED)
