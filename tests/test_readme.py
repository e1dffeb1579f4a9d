"""What the README tells people to type, typed."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_ten_lines_run_and_the_player_scores_what_a_player_scores(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code.strip().splitlines()) <= 12
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102  # that is the point
    mean, _ = (float(x) for x in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)[:2])
    assert mean > 5, "the hand-written pursuer catches nearly all: 10 for a capture, minus half a point per second"


def test_every_file_it_points_to_exists() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target


def test_its_results_are_those_of_the_stored_run() -> None:
    results = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    for task in results["tasks"].values():
        for player in task["players"].values():
            assert f"{player['iqm']:.2f} [{player['ci_low']:.2f}, {player['ci_high']:.2f}]" in README
