"""RLlib trains policies that play in agents.compare; in a virtual environment with RLlib (configs/constraints-ray.txt).

If RLlib cannot be installed there, the tests are skipped.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ray_venv import add_rllib, run_case

pytestmark = pytest.mark.slow

CASES = (
    "rows_are_those_of_the_native_environment",
    "settings_without_an_equal_are_refused_in_one_line",
    "a_policy_trained_with_a_runner_plays_in_the_comparison",
    "an_exported_policy_acts_as_in_rllib",
    "an_interrupted_training_continues",
    "pursuers_and_evaders_learn_a_policy_each",
    "agents_of_a_team_learn_a_network_each_which_play_in_the_comparison",
)


@pytest.fixture(scope="module")
def python(ray_python: Path) -> Path:
    """The interpreter of a virtual environment with flockenv's requirements and RLlib."""
    add_rllib(ray_python)
    return ray_python


@pytest.mark.parametrize("case", CASES)
def test_rllib(case: str, python: Path) -> None:
    run_case(python, "tests.rllib_cases", case)
