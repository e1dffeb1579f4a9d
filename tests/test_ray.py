"""The Ray engine gives the same results as the local one, and loses nothing; in a virtual environment with Ray.

RLlib pins gymnasium, so Ray gets an environment of its own, by configs/constraints-ray.txt. If it cannot be installed,
the tests are skipped.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
CASES = (
    "results_are_the_same_on_one_node_and_on_two",
    "a_killed_worker_loses_nothing",
    "a_killed_node_loses_nothing",
    "each_node_is_warmed_once_before_any_job",
    "a_worker_uses_one_thread_and_a_job_gets_its_memory",
    "errors_of_methods_and_a_search_are_the_same",
    "memory_of_the_driver_does_not_grow_with_the_number_of_jobs",
)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a new virtual environment with flockenv's requirements, Ray and what searches need."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    folder = tmp_path_factory.mktemp("ray") / "venv"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    extras = project["optional-dependencies"]
    searches = [requirement for requirement in extras["train"] if requirement.startswith("cmaes")]
    command = [folder / "bin" / "pip", "install", "-q", "-c", ROOT / "configs" / "constraints-ray.txt"]
    done = subprocess.run(
        [*command, *project["dependencies"], *extras["ray"], *searches], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"Ray cannot be installed: {done.stderr.strip().splitlines()[-1]}")
    return folder / "bin" / "python"


@pytest.mark.parametrize("case", CASES)
def test_ray(case: str, python: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    done = subprocess.run(
        [python, "-m", "tests.ray_cases", case], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
