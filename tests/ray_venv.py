"""Virtual environments with Ray, whose packages are those of configs/constraints-ray.txt."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

__all__ = ["new_venv", "run_case"]

ROOT = Path(__file__).resolve().parent.parent


def new_venv(folder: Path, extra: str, *others: str) -> Path:
    """Return the interpreter of a new virtual environment with flockenv's requirements and those of an extra.

    others: packages of the extra `train` that are needed too. If a package cannot be installed, the test is skipped.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    extras = project["optional-dependencies"]
    more = [requirement for requirement in extras["train"] if requirement.startswith(others)]
    packages = [*project["dependencies"], *extras[extra], *more]
    command = [folder / "bin" / "pip", "install", "-q", "-c", ROOT / "configs" / "constraints-ray.txt", *packages]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the extra {extra!r} cannot be installed: {done.stderr.strip().splitlines()[-1]}")
    return folder / "bin" / "python"


def run_case(python: Path, module: str, case: str) -> None:
    """Run a case, a function of a module of tests/, with another interpreter; raise AssertionError if it fails."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    done = subprocess.run([python, "-m", module, case], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
