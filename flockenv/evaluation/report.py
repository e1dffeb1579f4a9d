"""Report of a comparison: one dictionary of results, from which tables, sentences and Markdown are made."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from flockenv.evaluation.comparison import Comparison, compare, summarise
from flockenv.evaluation.episodes import Episodes, Interval
from flockenv.evaluation.plots import Column, Row

__all__ = [
    "INTERVAL", "MICROSECONDS", "all_rounded", "chart_column", "conditions", "differences", "grid", "interval_fields",
    "interval_text", "json_text", "markdown", "number_text", "player_tables", "rounded", "seeds_text", "table_of",
    "task_results", "verdict",
]  # fmt: skip

Results = dict[str, Any]

MICROSECONDS = "µs: per decision, all worlds at once / one row alone"

SEEDS_HEADER = "seeds: lowest, highest"

INTERVAL = "95 % two-level percentile bootstrap over seeds and worlds; shares of one seed: 95 % Wilson"

NOTES = f"""\
Return: the mean reward of a world's learners, summed over its episode; higher is better. Every player met the same
worlds, and no player was trained or tuned on one of them. A player with several training or search seeds has the mean
over all of them, with the number of seeds and the lowest and the highest mean of a seed. Intervals: 95 %, two-level
bootstrap over seeds and worlds; of a single seed over worlds alone, and then they do not contain the luck of training
or of the search. Success and "scores higher" (ties count half) of single seeds: 95 % Wilson. Level: the interval of the
difference contains 0. {MICROSECONDS} (medians; in a large comparison other cores
play other tasks meanwhile)."""


def task_results(
    digest: str,
    episodes: Mapping[str, Mapping[str, Episodes]],
    costs: Mapping[str, Results],
    resamples: int,
    seed: int,
    differences: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Results:
    """Return the results of one task as plain data: players in order, and the difference of each pair, later - earlier.

    episodes: by player and by the name of its run, the one that ships first. differences: by player, the differences
    between this task and the one that it was trained on.
    """
    runs = {name: list(played.values()) for name, played in episodes.items()}
    pairs = {
        f"{later} - {earlier}": _pair(compare(runs[later], runs[earlier], resamples, seed))
        for earlier, later in reversed(list(combinations(runs, 2)))
    }
    players = {
        name: {**_player(played, costs.get(name, {}), resamples, seed), "differs": list(differences.get(name, ()))}
        for name, played in episodes.items()
    }
    first = next(iter(runs.values()))[0]
    results = {"digest": digest, "horizon": first.horizon, "players": players, "pairs": pairs}
    return {**results, "verdict": verdict(first.task, results)}


def _player(played: Mapping[str, Episodes], cost: Results, resamples: int, seed: int) -> Results:
    runs = list(played.values())
    summary, means = summarise(runs, resamples, seed), [float(run.returns.mean()) for run in runs]
    return {
        "runs": list(played),
        **interval_fields("mean", "mean", summary.mean),
        "lowest": min(means),
        "highest": max(means),
        **interval_fields("success_rate", "success", summary.success),
        "worlds": runs[0].worlds,
        "episode_length": float(np.mean([run.lengths for run in runs])),
        "metrics": {name: {"mean": _number(mean), "worlds": n} for name, (mean, n) in summary.metrics.items()},
        "terms": {name: float(np.mean([run.terms[name] for run in runs])) for name in runs[0].terms},
        "microseconds_per_decision": float(np.median([run.microseconds for run in runs])),
        "microseconds_single": float(np.median([run.latency for run in runs])),
        "cost": cost,
        "returns": [[rounded(value) for value in run.returns] for run in runs],
    }


def rounded(value: float, digits: int = 6) -> float:
    """Return a number rounded to some significant digits, as it is stored; an integer stays as it is."""
    return value if isinstance(value, int) else float(f"{value:.{digits}g}")


def _pair(pair: Comparison) -> Results:
    return {
        **interval_fields("difference", "ci", pair.difference),
        **interval_fields("probability_better", "better", pair.better),
        "worlds": pair.worlds,
        "separated": pair.separated,
    }


def interval_fields(name: str, prefix: str, interval: Interval) -> Results:
    """Return an interval as three plain numbers, which interval_text reads."""
    return {name: interval.value, f"{prefix}_low": interval.low, f"{prefix}_high": interval.high}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None  # JSON has no NaN


def verdict(task: str, results: Results) -> str:
    """Return a sentence: which player is ahead by how much in the same worlds, and the cost of both.

    It is about ppo and rules if both played, else about the two players with the best means.
    """
    players = results["players"]
    if len(players) < 2:
        return f"{task}: only one player, no comparison."
    names = ("ppo", "rules")
    if not players.keys() >= set(names):
        names = tuple(sorted(players, key=lambda name: -players[name]["mean"])[:2])
    key = next(key for key in results["pairs"] if set(key.split(" - ")) == set(names))
    pair, (first, second) = results["pairs"][key], key.split(" - ")
    if pair["difference"] < 0:
        pair, first, second = _reverse(pair), second, first
    gap = interval_text(pair, "difference", "ci")
    wins = f"{percent_text(pair, 'probability_better', 'better')} of the same {pair['worlds']} worlds"
    rates = f"success {players[first]['success_rate']:.0%} against {players[second]['success_rate']:.0%}"
    counts = [len(players[name]["runs"]) for name in (first, second)]
    if max(counts) > 1:
        rates += f"; seeds: {counts[0]} against {counts[1]}"
    if pair["separated"]:
        claim = f"{first} beats {second} by {gap} per world and scores higher in {wins}; {rates}."
    else:
        claim = f"{first} and {second} are level: difference {gap} per world, {first} scores higher in {wins}; {rates}."
    return f"{task}: {claim} {_costs(first, players[first])}; {_costs(second, players[second])}."


def differences(task: str, results: Results) -> Iterator[str]:
    """Yield a line for each player that was trained on a task with other arguments or scales."""
    for name, player in results["players"].items():
        if player["differs"]:
            yield f"{task}: {name} plays another task than it was trained on: {'; '.join(player['differs'])}."


def _reverse(pair: Results) -> Results:
    turned = {"difference": -pair["difference"], "ci_low": -pair["ci_high"], "ci_high": -pair["ci_low"]}
    better = {"probability_better": 1 - pair["probability_better"]}
    return {**pair, **turned, **better, "better_low": 1 - pair["better_high"], "better_high": 1 - pair["better_low"]}


def _costs(name: str, player: Results) -> str:
    cost, spent = player["cost"], []
    if "wall_time_s" in cost:
        spent.append(duration_text(cost["wall_time_s"]))
    if "steps" in cost:
        spent.append(f"{steps_text(cost['steps'])} agent-steps")
    once = f"{' and '.join(spent)} of {cost.get('of', 'training')}, then " if spent else ""
    return f"{name} cost {once}{micro_text(player['microseconds_per_decision'])} µs per decision"


def player_tables(task: str, results: Results) -> Iterator[Table]:
    """Yield the tables of a task for a terminal of 80 columns: scores, then domain metrics, then pairs."""
    header, rows = player_cells(results)
    yield table_of(task, header[:4], [row[:4] for row in rows])
    yield table_of(None, [header[0], *header[4:]], [[row[0], *row[4:]] for row in rows])
    if results["pairs"]:
        yield table_of(None, *pair_cells(results))


def table_of(title: str | None, header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table for a terminal; its text is not interpreted as markup."""
    table = Table(
        title=title and escape(title), title_style="bold", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1)
    )
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="left" if k == 0 else "right", no_wrap=k == 0)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def player_cells(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: one row per player."""
    players = results["players"]
    metrics = list(next(iter(players.values()))["metrics"])
    header = ["player", "mean [95 %]", SEEDS_HEADER, "success [95 %]", *(m.replace("_", " ") for m in metrics), "µs"]
    rows = [
        [
            name,
            interval_text(player, "mean", "mean"),
            seeds_text(player),
            percent_text(player, "success_rate", "success"),
            *(number_text(player["metrics"][metric]["mean"]) for metric in metrics),
            f"{micro_text(player['microseconds_per_decision'])} / {micro_text(player['microseconds_single'])}",
        ]
        for name, player in players.items()
    ]
    return header, rows


def pair_cells(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: one row per pair."""
    header = ["same worlds", "difference [95 %]", "higher in [95 %]"]
    rows = [
        [
            name,
            interval_text(pair, "difference", "ci") + ("" if pair["separated"] else " (level)"),
            percent_text(pair, "probability_better", "better"),
        ]
        for name, pair in results["pairs"].items()
    ]
    return header, rows


def chart_column(task: str, results: Results) -> Column:
    """Return the column of one task in the picture: all players, and the differences between all but random actions."""

    def interval(about: Results, name: str, prefix: str) -> Interval:
        return Interval(about[name], about[f"{prefix}_low"], about[f"{prefix}_high"])

    rows = [
        Row(
            name, interval(player, "mean", "mean"), interval(player, "success_rate", "success"),
            np.mean(player["returns"], axis=0),
        )
        for name, player in results["players"].items()
    ]  # fmt: skip
    pairs = {name: interval(pair, "difference", "ci") for name, pair in results["pairs"].items()}
    steering = {name: pair for name, pair in pairs.items() if "random" not in name.split(" - ")}
    return Column(task, rows, steering or pairs)


SCALAR = r'"[^"\n]*": (?:"(?:[^"\\\n]|\\.)*"|-?[\d.eE+-]+|true|false|null)'
"""An entry of an object in JSON whose value has no parts."""


def all_rounded(value: Any, digits: int = 6) -> Any:
    """Return data with all floats rounded to some significant digits."""
    if isinstance(value, Mapping):
        return {key: all_rounded(each, digits) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [all_rounded(each, digits) for each in value]
    return rounded(value, digits) if isinstance(value, float) else value


def json_text(results: Mapping[str, Any]) -> str:
    """Return the results as strict JSON with few lines.

    A list of numbers, an innermost object, and entries without parts that follow each other are on one line each.
    """
    text = json.dumps(results, indent=1, allow_nan=False, ensure_ascii=False)
    text = re.sub(r"\[\n\s*([-+.\deE,\s]*?)\n\s*\]", lambda m: f"[{''.join(m[1].split())}]", text)
    inner = r"\{\n\s*((?:[^{}\[\]]|\{\}|\[\])*)\n\s*\}"  # what a string has of such brackets only keeps its lines apart
    text = re.sub(inner, lambda m: "{" + re.sub(r"\n\s*", " ", m[1]) + "}", text)
    return re.sub(rf"({SCALAR},)\n\s+(?={SCALAR}(?:,|\n))", r"\1 ", text) + "\n"


def conditions(results: Results) -> str:
    """Return the number of worlds, changed arguments and disturbance: "256 worlds per task, noise 0.05"."""
    changes = [
        f"{task}.{key} = {value}" for task, each in results.get("changes", {}).items() for key, value in each.items()
    ]
    disturbance = [f"{name} {value:g}" for name, value in results.get("disturbance", {}).items() if value]
    return ", ".join([f"{results['worlds']} worlds per task", *changes, *disturbance])


def markdown(results: Results) -> str:
    """Return the whole comparison as a Markdown page."""
    seeds = f"{results['world_seeds']['first']} to {results['world_seeds']['last']}"
    parts = ["# Hand-written steering against learning", f"{conditions(results)}, seeds {seeds}."]
    for task, about in results["tasks"].items():
        parts += [f"## {task}", about["verdict"], *differences(task, about), grid(*player_cells(about))]
        parts += [grid(*pair_cells(about))] if about["pairs"] else []
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    return "\n\n".join([*parts, "---", NOTES, f"Made with {versions}.\n"])


def grid(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---", *("---:" for _ in header[1:])], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def interval_text(about: Results, name: str, prefix: str) -> str:
    """Return 'value [low, high]' with digits down to a twentieth of the interval's width."""
    value, low, high = about[name], about[f"{prefix}_low"], about[f"{prefix}_high"]
    width = 0.0 if math.isclose(low, high) else high - low  # resampled means of equal numbers differ by rounding
    digits = min(6, max(0, math.ceil(1.3 - math.log10(width)))) if width > 0 else 3
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def seeds_text(player: Results) -> str:
    """Return the number of a player's seeds, and the lowest and highest mean of a seed: '10: 7.9, 8.2'."""
    count = len(player["runs"])
    return f"{count}: {number_text(player['lowest'])}, {number_text(player['highest'])}" if count > 1 else str(count)


def percent_text(about: Results, name: str, prefix: str) -> str:
    """Return a share and its interval as text, '78 % [73, 83]', from the entries of `about`."""
    value, low, high = (100 * about[key] for key in (name, f"{prefix}_low", f"{prefix}_high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"


def number_text(value: float | None) -> str:
    """Return a number at three significant digits, or a dash if there is none."""
    if value is None:
        return "–"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value + 0.0:.3g}"  # + 0.0: no "-0"


def steps_text(steps: float) -> str:
    """Return a number of steps as text: '950' or, in millions from 100,000 on, '10.7 M'."""
    return f"{steps / 1e6:.1f} M" if steps >= 1e5 else f"{steps:,.0f}"


def micro_text(microseconds: float) -> str:
    """Return microseconds at two digits, or as an integer."""
    return f"{microseconds:.0f}" if microseconds >= 10 else f"{microseconds:.2g}"


def duration_text(seconds: float) -> str:
    """Return a duration as text: '45 s' or, from 90 s on, '4.2 min'."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"
