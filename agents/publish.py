"""Publish a comparison in README.md and docs/: `python -m agents.compare --worlds 128 && python -m agents.publish`.

Copies results.json and comparison.png into docs/, draws docs/summary.png, and writes the tables of README.md and of
docs/results.md, so that all of them are from one run.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from agents.compare import ROOT
from agents.experiment import one_line_errors
from agents.summary_chart import write_summary
from flockenv.cli.terminal import run_program
from flockenv.core.atomic_files import write_all_or_none
from flockenv.evaluation.report import Results, conditions, grid, seeds_text
from flockenv.players import NAMES
from flockenv.tasks import TASKS

__all__ = ["BLOCK", "WORLDS", "app", "summary", "tables"]

WORLDS = 128
"""Smallest number of worlds of a comparison that is published: more than README's command plays in two minutes."""

BLOCK = re.compile(r"(?<=<!-- python -m agents\.publish -->\n).*?(?=<!-- end -->)", re.DOTALL)
"""The part of a page between its two marks."""

SHOWN = ("random", "textbook", "rules", "ppo")
"""Players with a column of their own; the others, of some tasks each, have a table below."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def tables(results: Results) -> str:
    """Return the two tables of docs/results.md: the players of every task, and those of some tasks."""
    header = ["task", *(f"`{name}`" for name in SHOWN), "`ppo` - `rules`, in the same worlds"]
    rows = [
        [task, *(_score(about["players"][name]) for name in SHOWN), _lead(about["pairs"]["ppo - rules"])]
        for task, about in results["tasks"].items()
    ]
    others = list(_other_rows(results))
    return (
        f"{grid(header, rows)}\n\n{grid(['task', 'player', 'score', '`ppo` - player, in the same worlds'], others)}\n"
    )


def summary(results: Results) -> str:
    """Return README's table: scores at two digits, the seeds of each player, and success rates below 100 %."""
    header = ["task", *(f"`{name}`" for name in SHOWN), "`ppo` - `rules`"]
    rows = [
        [task, *(_short_score(about["players"][name]) for name in SHOWN), _short_lead(about["pairs"]["ppo - rules"])]
        for task, about in results["tasks"].items()
    ]
    return f"{grid(header, rows)}\n"


def _short_score(player: Results) -> str:
    score, rate = _digits(player["mean"]), f"{player['success_rate']:.0%}"
    if len(player["runs"]) > 1:
        score += f" ({len(player['runs'])}: {_digits(player['lowest'])}, {_digits(player['highest'])})"
    return score if rate == "100%" else f"{score}, {rate}"


def _short_lead(pair: Results) -> str:
    return f"{'+' * (pair['difference'] > 0)}{_digits(pair['difference'])}" if pair["separated"] else "level"


def _digits(value: float) -> str:
    """Return a number at two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def _other_rows(results: Results) -> Iterator[list[str]]:
    for task, about in results["tasks"].items():
        for name, player in about["players"].items():
            if name not in SHOWN:
                yield [task, f"`{name}`", _score(player), _lead(about["pairs"][f"ppo - {name}"])]


def _score(player: Results) -> str:
    """Return the mean with its interval, its seeds if there are several, and the success rate if it is below 100 %."""
    rate, seeds = f"{player['success_rate']:.0%}", f" ({seeds_text(player)})" if len(player["runs"]) > 1 else ""
    score = f"{player['mean']:.2f} [{player['mean_low']:.2f}, {player['mean_high']:.2f}]{seeds}"
    return score if rate == "100%" else f"{score}, {rate}"


def _lead(pair: Results) -> str:
    difference = f"{pair['difference']:+.2f} [{pair['ci_low']:+.2f}, {pair['ci_high']:+.2f}]"
    level = "" if pair["separated"] else "level: "
    return f"{level}{difference}, higher in {pair['probability_better']:.0%}"


def _read_comparison(file: Path) -> Results:
    """Return a comparison; raise ValueError unless it is complete: all tasks, the usual players, all worlds."""
    if not file.is_file():
        raise ValueError(f"{file}: no such file; `python -m agents.compare --worlds {WORLDS}` writes it")
    try:
        results = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: is not JSON: {error}") from None
    if not isinstance(results, dict):
        raise ValueError(f"{file}: must be an object, the results of `python -m agents.compare`")
    missing = [task for task in TASKS if task not in results["tasks"]] + [
        n for n in SHOWN if n not in results["players"]
    ]
    others = [name for name in results["players"] if name not in NAMES]
    few = results["smoke"] or results["worlds"] < WORLDS
    what = f"a comparison with {others[0]}, which does not ship," if others else ""
    what = f"a part of a comparison, without {missing[0]}," if missing else what
    what = f"a quick look (--smoke, or without --worlds {WORLDS})" if few else what
    if results.get("changes") or any(results.get("disturbance", {}).values()):
        what = f"a comparison of {conditions(results)}"
    if what:
        raise ValueError(f"{file}: {what} must not be published")
    return results


@app.command()
def main(
    folder: Annotated[Path, typer.Argument(help="folder with the files of `python -m agents.compare`")] = Path(
        "results"
    ),
    root: Annotated[Path, typer.Option(help="checkout in which pages are written")] = ROOT,
) -> None:
    """Copy a comparison's results and picture into docs/, draw its summary, and write the tables of the pages."""
    with one_line_errors():
        file = folder / "results.json"
        try:
            results = _read_comparison(file)
            written = {"README.md": summary(results), "docs/results.md": tables(results)}
        except KeyError as error:
            raise ValueError(f"{file}: {error} is missing; `python -m agents.compare` writes it") from None
        contents = {f"docs/{name}": (folder / name).read_bytes() for name in ("results.json", "comparison.png")}
        for name, table in written.items():
            contents[name] = _page_with_table(root / name, table).encode()
        writers = {name: functools.partial(_write, content) for name, content in contents.items()}
        writers["docs/summary.png"] = functools.partial(write_summary, results=results)
        write_all_or_none(root, writers)
    for name in writers:
        typer.echo(f"{root / name}: written")


def _page_with_table(path: Path, table: str) -> str:
    """Return a page with a new table between its two marks."""
    text = path.read_text(encoding="utf-8")
    if len(BLOCK.findall(text)) != 1:
        raise ValueError(f"{path}: must have one place for the tables, between its two marks")
    return BLOCK.sub(lambda _: table, text)


def _write(content: bytes, path: Path) -> None:
    path.write_bytes(content)


if __name__ == "__main__":
    run_program("publish", app)
