"""docs/extending.md: the Python blocks of each section run as a script, and print the numbers of the page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.page_scripts import ROOT, numbers, python_of, run_python

PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
TUTORIALS = ("Your own effect", "Your own behaviour", "Your own integrator", "Your own task", "Your own player")


def script_of(section: str) -> str:
    """Return the Python blocks of a section, one after another."""
    (text,) = re.findall(rf"^## {section}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return python_of(text)


def printed(section: str, folder: Path) -> list[str]:
    """Run a tutorial as a script in an empty folder; return the lines it prints."""
    return run_python(script_of(section), folder)


def test_every_python_block_of_the_page_is_part_of_a_tutorial() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 2 * len(TUTORIALS)
    scripts = [script_of(section) for section in TUTORIALS]
    assert all(sum(block in script for script in scripts) == 1 for block in blocks)


def test_the_wind_of_the_page_moves_agents_by_its_mean_force(tmp_path: Path) -> None:
    """Two whole periods: v = push / 2 / m = 0.75 m/s along x."""
    assert numbers(" ".join(printed(TUTORIALS[0], tmp_path))) == pytest.approx([0.75, 0] * 2, abs=1e-5)


@pytest.mark.slow
def test_agents_settle_on_the_orbit_that_the_page_computes(tmp_path: Path) -> None:
    """d = R + m V / weight = 5.2 m."""
    assert numbers(" ".join(printed(TUTORIALS[1], tmp_path))) == pytest.approx([5.2] * 8, abs=0.1)


@pytest.mark.slow
def test_the_task_of_the_page_is_solved_in_every_world_and_is_an_environment(tmp_path: Path) -> None:
    rollout, environment, vector = printed(TUTORIALS[3], tmp_path)
    success, longest = numbers(rollout)
    assert success == 1
    assert 10 < longest < 150
    assert environment.startswith("Box(-1.0, 1.0, (4,), float32)")
    assert environment.endswith("False)")
    assert vector == "(3, 4)"


def test_the_integrator_has_second_order(tmp_path: Path) -> None:
    assert numbers(" ".join(printed(TUTORIALS[2], tmp_path))) == pytest.approx([2.0], abs=0.05)


def test_the_player_of_the_page_scores_more_than_a_random_player(tmp_path: Path) -> None:
    scores, comparison = printed(TUTORIALS[4], tmp_path)
    mine, chance, success = numbers(scores)
    assert success == 1
    assert mine > 5 > 0 > chance
    assert "worlds=16" in comparison
