"""Ship players of several seeds: `python -m agents.ship results/ppo results/tune`.

Reads the policies TASK-seed-N.safetensors that `agents.ppo --seeds` has written, and the searches
TASK-PLAYER-seed-N.json of `agents.tune`. Of each task and player the run with the median score on tuning worlds becomes
the one that ships; the others are kept for NAME@N. Runs that ship already take part unless they are of another recipe,
or a folder has their seed. Plays nothing, and writes all files or none, with the table of docs/players.md; without a
folder it writes the table alone.
"""

from __future__ import annotations

import functools
import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel, ValidationError

from agents.compare import ROOT, experiment_of
from agents.experiment import PpoSettings, one_line_errors
from agents.run import first_difference
from agents.search import Coordinates, Found, median_of
from agents.tune import content_of, found_of
from flockenv.cli.terminal import run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import printable_path, refusals
from flockenv.core.warnings import OtherTaskWarning
from flockenv.evaluation.report import grid, json_text, rounded
from flockenv.players.model_card import model_card
from flockenv.players.policy import MlpPolicy
from flockenv.players.rules import PLAYERS, read_tuned
from flockenv.players.rules.parameter import ranges_of
from flockenv.tasks import TASKS

__all__ = ["BLOCK", "Files", "app", "ship", "trainings"]

PLAYERS_FOLDER, PAGE = "flockenv/players", "docs/players.md"

BLOCK = re.compile(r"(?<=<!-- python -m agents\.ship -->\n).*?(?=<!-- end -->)", re.DOTALL)
"""The part of the page between its two marks."""

KEPT_EQUAL = ("algorithm", "rules", "hybrid")
"""Entries of a card that belong to its recipe but are not in a config: the rules as they were when it was trained."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

Content = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained policy: its weights as bytes, and its card."""

    path: Path
    data: bytes
    card: Content

    @property
    def seed(self) -> int:
        """The training seed."""
        return int(self.card["seed"])

    @property
    def tuning_mean(self) -> float:
        """The mean return on tuning worlds."""
        return float(self.card["tuning_mean"])

    @property
    def recipe(self) -> Content:
        """What training depended on, without the seed; settings newer than the card have their defaults."""
        return {
            "arguments": _complete(TASKS[self.card["task"]], self.card["arguments"]),
            "layout": self.card["layout"],
            "ppo": _without_seed(_complete(PpoSettings, self.card["recipe"]["ppo"])),
            **{key: self.card[key] for key in KEPT_EQUAL if key in self.card},
        }


def ship(folders: Sequence[Path], root: Path = ROOT) -> list[str]:
    """Write the runs of folders into a checkout; return a line for each player.

    Raises:
        ValueError: in one line, before anything is written: a file that is no run, one of another recipe, or a second
            one of a seed.
    """
    policies = [path for folder in folders for path in sorted(folder.glob("*-seed-*.safetensors"))]
    searches = [path for folder in folders for path in sorted(folder.glob("*-seed-*.json"))]
    searches = [path for path in searches if path.with_suffix(".safetensors") not in policies]
    if folders and not policies and not searches:
        names = ", ".join(map(printable_path, folders))
        raise ValueError(f"{names}: neither TASK-seed-N.safetensors nor TASK-PLAYER-seed-N.json in it")
    seen: set[str] = set()
    for path in (*policies, *searches):
        if path.name in seen:
            raise ValueError(f"{printable_path(path)}: another folder has a run of that seed too")
        seen.add(path.name)
    files, lines = Files(root), []
    by_task = _by(lambda run: str(run.card["task"]), map(_read_policy, policies))
    for task, trained in by_task.items():
        lines += _ship_policies(task, trained, files)
    for task, found in _by(lambda run: run.task, map(_read_search, searches)).items():
        lines += _ship_searches(task, found, files)
    page = (root / PAGE).read_text(encoding="utf-8")
    files.new[PAGE] = BLOCK.sub(lambda _: trainings(files), page).encode()
    write_all_or_none(root, {name: functools.partial(_write, content) for name, content in files.new.items()})
    _remove_others(files, by_task)
    return lines


class Files:
    """The files of a checkout, of which some are to be written: `new`, content by name."""

    def __init__(self, root: Path) -> None:
        self.root, self.new = root, dict[str, bytes]()

    def json(self, name: str) -> Content | None:
        """Return what a file will contain; None if there is none."""
        if name not in self.new and not (self.root / name).is_file():
            return None
        content: Content = json.loads(self.new.get(name) or (self.root / name).read_bytes())
        return content


def trainings(files: Files) -> str:
    """Return the table of docs/players.md: where the learning curves of the policies that ship pass the tuned rules."""
    header = ["task", "rules", "passed at", "seconds", "agent-steps", "whole training, s", "seeds that pass"]
    cards = {task: files.json(f"{PLAYERS_FOLDER}/weights/{task}.json") for task in sorted(TASKS)}
    return f"{grid(header, [_row(task, card, files) for task, card in cards.items() if card])}\n"


def _row(task: str, card: Content, files: Files) -> list[str]:
    tuned = files.json(f"{PLAYERS_FOLDER}/tuned/{task}.json") or {"players": {}}
    rules = tuned["players"].get("rules", {}).get("found", {}).get("tuning_mean", -math.inf)
    past = next((point for point in card["curve"] if point["mean"] > rules), None)
    cells = ["never", "", ""]
    if past is not None:
        cells = [f"{past['mean']:.2f}", f"{past['seconds']:.0f}", f"{past['steps'] / 1e6:.1f} M"]
    scores = card.get("seeds", {}).get("scores", {card["seed"]: card["tuning_mean"]}).values()
    passing = f"{sum(score > rules for score in scores)} of {len(scores)}"
    return [task, f"{rules:.2f}", *cells, f"{card['wall_time_s']:.0f}", passing]


def _by(key: Callable[[Any], str], runs: Any) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for run in runs:
        found.setdefault(key(run), []).append(run)
    return found


# --- policies ---------------------------------------------------------------------------------------------------------


def _ship_policies(task: str, trained: Sequence[Trained], files: Files) -> list[str]:
    """Add the files of a task's policies; return the line about them."""
    wanted = _recipe(task, trained[0])
    for run in trained:
        if other := _difference(run, wanted):
            raise ValueError(f"{printable_path(run.path)}: {other}")
    new = {run.seed for run in trained}
    ships_now = [run for run in _shipped(task, files.root) if run.seed not in new]
    runs = [*trained, *(run for run in ships_now if _difference(run, wanted) is None)]
    left_out = [str(run.seed) for run in ships_now if run not in runs]
    ships, scores = median_of(runs), {run.seed: rounded(run.tuning_mean) for run in runs}
    about = {"scores": {str(seed): scores[seed] for seed in sorted(scores)}, **_ends(scores)}
    for run in runs:
        name = f"{PLAYERS_FOLDER}/weights/{task if run is ships else f'seeds/{task}-seed-{run.seed}'}"
        card = _card(run, about if run is ships else None)
        text = json_text(card) if run is ships else json.dumps(card, separators=(",", ":"), allow_nan=False) + "\n"
        files.new |= {f"{name}.safetensors": run.data, f"{name}.json": text.encode()}
        if run is ships:
            files.new[f"{name}.md"] = model_card(card).encode()
    without = f"; of another recipe, left out: {', '.join(left_out)}" if left_out else ""
    return [f"{task}, ppo: {_line(ships.seed, about)}{without}"]


def _difference(run: Trained, wanted: Content) -> str | None:
    """Return the first difference between a policy's recipe and that of its config; None if they are equal."""
    try:
        found = first_difference(run.recipe, wanted)
    except ValueError as error:
        return str(error)
    if found is None:
        return None
    key, has, wants = found
    return f"{key} = {has}: another recipe than configs/training/{run.card['task']}.yaml, with {wants}"


def _recipe(task: str, run: Trained) -> Content:
    """Return the recipe that all policies of a task must have: that of the config, with a run's KEPT_EQUAL."""
    experiment = experiment_of(task)
    built = experiment.build()
    return {
        "arguments": built.model_dump(mode="json"),
        "layout": built.layout.digest,
        "ppo": _without_seed(experiment.ppo.model_dump(mode="json")),
        **{key: run.card[key] for key in KEPT_EQUAL if key in run.card},
    }


def _complete(kind: type[BaseModel], values: Content) -> Content:
    """Return the values of a record as plain data, with defaults for those that are missing."""
    try:
        return kind.model_validate_json(json.dumps(values)).model_dump(mode="json")
    except ValidationError as error:
        raise ValueError(f"its card's {refusals(error, kind, values)[0]}") from None


def _without_seed(settings: Content) -> Content:
    return {key: value for key, value in settings.items() if key != "seed"}


def _read_policy(path: Path) -> Trained:
    """Return the policy of a file; raise ValueError, in one line, if it cannot be shipped."""
    name, _, seed = path.stem.rpartition("-seed-")
    if name not in TASKS:
        raise ValueError(f"{printable_path(path)}: {name!r} is no task; a policy is TASK-seed-N.safetensors")
    run = _load(path, name)
    lacks = [key for key in ("task", "seed", "tuning_mean", "recipe", "arguments", "layout") if key not in run.card]
    if lacks:
        raise ValueError(f"{printable_path(path)}: its card has no {lacks[0]}")
    if (run.card["task"], str(run.seed)) != (name, seed):
        raise ValueError(f"{printable_path(path)}: its card is of {run.card['task']!r}, seed {run.seed}")
    return run


def _load(path: Path, task: str) -> Trained:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OtherTaskWarning)  # another recipe is refused later
        policy = MlpPolicy.load(path, experiment_of(task).build())
    return Trained(path, path.read_bytes(), dict(policy.card))


def _shipped(task: str, root: Path) -> list[Trained]:
    """Return the policies that ship now, or are kept beside, if they can play the task."""
    ships = root / PLAYERS_FOLDER / "weights" / f"{task}.safetensors"
    others = sorted((ships.parent / "seeds").glob(f"{task}-seed-*.safetensors"))
    return [_load(path, task) for path in (ships, *others) if path.is_file()]


def _card(run: Trained, seeds: Content | None) -> Content:
    """Return the card that is written; seeds: the scores of all seeds, of the policy that ships."""
    command = f"python -m agents.ppo configs/training/{run.card['task']}.yaml --seed {run.seed}"
    card = {key: value for key, value in run.card.items() if key != "seeds"}
    card["recipe"] = {**card["recipe"], "command": command}
    if seeds is None:
        card["curve"] = [{key: rounded(value) for key, value in point.items()} for point in card["curve"]]
    return card if seeds is None else {**card, "seeds": seeds}


def _remove_others(files: Files, tasks: Iterable[str]) -> None:
    """Remove policies of tasks that were written that are no longer kept; no card lists them any more."""
    folder = f"{PLAYERS_FOLDER}/weights/seeds"
    for path in [path for task in tasks for path in (files.root / folder).glob(f"{task}-seed-*")]:
        if f"{folder}/{path.name}" not in files.new:
            path.unlink()


# --- hand-written players ---------------------------------------------------------------------------------------------


def _ship_searches(task: str, found: Sequence[Found], files: Files) -> list[str]:
    """Add the file of a task's tuned parameters; return a line for each player."""
    name = f"{PLAYERS_FOLDER}/tuned/{task}.json"
    players, lines = read_tuned(files.root / name), []
    for player, new in _by(lambda run: run.player, found).items():
        before = _searched(new[0], players.get(player, {}).get("found", {}))
        others = [run for run in before if run.seed not in {each.seed for each in new}]
        runs = [*new, *(run for run in others if _is_same_search(run, new[0]))]
        left_out = [str(run.seed) for run in others if run not in runs]
        ships = median_of(runs)
        about = found_of(ships, sorted(runs, key=lambda run: run.seed))
        players[player] = {"parameters": ships.parameters, "found": about}
        without = f"; of another search, left out: {', '.join(left_out)}" if left_out else ""
        lines.append(f"{task}, {player}: {_line(ships.seed, about)}{without}")
    files.new[name] = json_text(content_of(task, players)).encode()
    return lines


def _searched(like: Found, about: Content) -> list[Found]:
    """Return the searches that a file of tuned parameters has of a player; what it does not say is that of `like`."""
    ranges = Coordinates(ranges_of(PLAYERS[like.player][like.task][1]))
    common = {key: about[key] for key in ("textbook_mean", "textbook_success", "tuning_worlds") if key in about}
    runs = []
    for seed, each in about.get("searches", {}).items():
        points = [dict(zip(each["curve"], values, strict=True)) for values in zip(*each["curve"].values(), strict=True)]
        known = each["parameters"].keys() == ranges.ranges.keys()
        runs.append(replace(
            like, **common, seed=int(seed), parameters=each["parameters"], tuning_mean=about["scores"][seed],
            tuning_success=each["success"], agent_steps=each["agent_steps"], seconds=each["seconds"], curve=points,
            at_bounds=ranges.at_bounds(each["parameters"]) if known else {},
        ))  # fmt: skip
    return runs


def _is_same_search(one: Found, other: Found) -> bool:
    """Return True if two searches had the same parameters, tuning worlds, rules and, within a generation, budget."""
    same = ("textbook_mean", "textbook_success", "tuning_worlds")
    return (
        one.parameters.keys() == other.parameters.keys()
        and all(getattr(one, key) == getattr(other, key) for key in same)
        and abs(one.agent_steps - other.agent_steps) <= 1.5 * other.agent_steps / max(other.generations, 1)
    )


def _read_search(path: Path) -> Found:
    """Return the outcome of a search; raise ValueError, in one line, if it is none of today's config."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = Found(**{each.name: content[each.name] for each in fields(Found)})
        settings, kind = content["settings"], PLAYERS[found.player][found.task][1]
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{printable_path(path)}: no outcome of a search, which agents.tune writes") from None
    wanted = experiment_of(found.task).search.model_dump(mode="json")
    names = sorted(each.name for each in fields(kind))
    if other := first_difference(
        {"search": _without_seed(settings), "parameters": sorted(found.parameters)},
        {"search": _without_seed(wanted), "parameters": names},
    ):
        key, has, wants = other
        raise ValueError(f"{printable_path(path)}: {key} = {has}: another search than that of today, with {wants}")
    return found


# --- both -------------------------------------------------------------------------------------------------------------


def _ends(scores: Mapping[int, float]) -> Content:
    return {"lowest": min(scores.values()), "highest": max(scores.values())}


def _line(seed: int, about: Content) -> str:
    scores = about["scores"]
    ends = f"{scores[str(seed)]:.3f}, all from {about['lowest']:.3f} to {about['highest']:.3f}"
    return f"seed {seed}, the median of {len(scores)}: {ends}"


def _write(content: bytes, path: Path) -> None:
    path.write_bytes(content)


@app.command()
def main(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="FOLDER", help="such as results/ppo and results/tune")
    ] = None,
    root: Annotated[Path, typer.Option(help="checkout in which files are written")] = ROOT,
) -> None:
    """Ship the median of several training or search seeds, and keep the others for NAME@N."""
    with one_line_errors():
        missing = next((folder for folder in folders or () if not folder.is_dir()), None)
        if missing is not None:
            raise ValueError(f"{printable_path(missing)}: no such folder")
        lines = ship(folders or [], root)
    for line in [*lines, f"written to {root / PLAYERS_FOLDER} and {root / PAGE}"]:
        typer.echo(line)


if __name__ == "__main__":
    run_program("ship", app)
