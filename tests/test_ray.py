"""The Ray engine gives the same results as the local one, and loses nothing; in a virtual environment with Ray.

RLlib pins gymnasium, so Ray gets an environment of its own, by configs/constraints-ray.txt. If it cannot be installed,
the tests are skipped.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ray_venv import run_case

pytestmark = pytest.mark.slow

CASES = (
    "results_are_those_of_a_cluster_of_two_nodes",
    "a_killed_worker_loses_nothing",
    "a_killed_node_loses_nothing",
    "each_node_is_warmed_once_before_any_job",
    "a_worker_uses_one_thread_and_a_job_gets_its_memory",
    "errors_of_methods_and_a_search_are_the_same",
    "memory_of_the_driver_does_not_grow_with_the_number_of_jobs",
)


@pytest.mark.parametrize("case", CASES)
def test_ray(case: str, ray_python: Path) -> None:
    run_case(ray_python, "tests.ray_cases", case)
