"""The README: its example runs, its links exist, and its tables are those of docs/results.json."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from agents import publish
from flockenv.tasks import TASKS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
RESULTS = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")


def test_the_example_runs_and_the_hand_written_player_scores_well(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code.strip().splitlines()) <= 12
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102  # the example of the README
    mean, deviation = (float(x) for x in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)[:2])
    said = re.findall(r"rounded `\(([\d.]+), ([\d.]+)\)`", README)
    assert [tuple(map(float, pair)) for pair in said] == [pytest.approx((mean, deviation), abs=0.05)]
    assert mean > 5, "the hand-written pursuer catches nearly all: 10 for a capture, minus half a point per second"


def test_every_linked_file_exists() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target


def test_the_tables_are_those_of_results_json() -> None:
    """If this fails, run `python -m agents.compare && python -m agents.publish`."""
    results = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    assert publish.BLOCK.findall(README) == [publish.summary(results)]
    assert publish.BLOCK.findall(RESULTS) == [publish.tables(results)]
    assert results["tasks"].keys() == TASKS.keys()
    for task in results["tasks"].values():
        for player in task["players"].values():
            assert f"{player['mean']:.2f} [{player['mean_low']:.2f}, {player['mean_high']:.2f}]" in RESULTS


def test_the_readme_is_short_and_its_tables_are_narrow() -> None:
    assert len(README.splitlines()) <= 150
    for table in re.findall(r"(?:^\|.*\n)+", README, re.MULTILINE):
        assert table.splitlines()[0].count("|") <= 7, "at most six columns"
    prose = re.sub(r"```.*?```|^\|.*$|^!.*$|\]\([^)]*\)|`[^`]*`", " ", README, flags=re.DOTALL | re.MULTILINE)
    for sentence in re.split(r"(?<=[.:;?])\s|\n\s*\n|^\* ", prose, flags=re.MULTILINE):
        assert len(sentence.split()) <= 30, sentence


def test_a_full_comparison_is_published_and_a_quick_or_partial_one_is_refused(tmp_path: Path) -> None:
    results = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    folder, root = tmp_path / "results", tmp_path / "checkout"
    (root / "docs").mkdir(parents=True)
    folder.mkdir()
    readme = publish.BLOCK.sub("old\n", README)
    (root / "README.md").write_text(readme, encoding="utf-8")
    (root / "docs" / "results.md").write_text(publish.BLOCK.sub("old\n", RESULTS), encoding="utf-8")
    (folder / "comparison.png").write_bytes(b"a picture")

    def published(results: Any) -> Any:
        if results is not None:
            (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
        return CliRunner().invoke(publish.app, [str(folder), "--root", str(root)])

    without = {**results, "tasks": {name: task for name, task in results["tasks"].items() if name != "herd"}}
    for given, message in (
        (None, "no such file; `python -m agents.compare --worlds 128` writes it"),
        ({**results, "worlds": 64}, "a quick look (--smoke, or without --worlds 128) must not be published"),
        ({**results, "smoke": True}, "a quick look (--smoke, or without --worlds 128) must not be published"),
        ({**results, "disturbance": {"noise": 0.1}}, "a comparison of 128 worlds per task, noise 0.1 must not be"),
        ({**results, "changes": {"herd": {"sheep": 3}}}, "128 worlds per task, herd.sheep = 3 must not be published"),
        (without, "a part of a comparison, without herd, must not be published"),
        ({**results, "players": {**results["players"], "mine": "mine.py"}}, "with mine, which does not ship, must not"),
        ({name: each for name, each in results.items() if name != "smoke"}, "results.json: 'smoke' is missing"),
        ([], "results.json: must be an object"),
    ):
        refused = published(given)
        assert refused.exit_code == 2 and message in refused.stderr and refused.stderr.count("\n") == 1
        assert (root / "README.md").read_text(encoding="utf-8") == readme
        assert [path.name for path in (root / "docs").iterdir()] == ["results.md"]
    done = published(results)
    assert done.exit_code == 0, done.output
    assert (root / "README.md").read_text(encoding="utf-8") == README
    assert (root / "docs" / "results.md").read_text(encoding="utf-8") == RESULTS
    assert (root / "docs" / "summary.png").read_bytes().startswith(b"\x89PNG")
    assert (root / "docs" / "results.json").read_bytes() == (folder / "results.json").read_bytes()
    assert (root / "docs" / "comparison.png").read_bytes() == b"a picture"
