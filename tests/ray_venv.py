"""A virtual environment with Ray or RLlib, whose versions are those of configs/constraints-ray.txt."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path
from typing import Any

import pytest

__all__ = ["add_rllib", "new_venv", "run_case"]

ROOT = Path(__file__).resolve().parent.parent
SITE = "import sysconfig; print(sysconfig.get_path('purelib'))"
TORCH = ("torch", "torchgen", "functorch")
"""What torch installs, beside its metadata."""


def new_venv(folder: Path) -> Path:
    """Return the interpreter of a new virtual environment with flockenv's requirements, Ray and what searches need.

    If a package cannot be installed, the test is skipped.
    """
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    project = _project()
    cmaes = [each for each in project["optional-dependencies"]["train"] if each.startswith("cmaes")]
    _install(python, "ray", [*project["dependencies"], *cmaes])
    return python


def add_rllib(python: Path) -> None:
    """Install RLlib beside Ray; if a package cannot be installed, the test is skipped.

    torch is that of the tests' own environment, if it has the wanted version: to install it again takes longer than
    most of the tests.
    """
    here, there = Path(sysconfig.get_path("purelib")), python.parent.parent / "torch"
    there.mkdir()
    for path in here.glob("*torch*"):
        if path.name.split("-")[0] in TORCH:
            (there / path.name).symlink_to(path)
    own = subprocess.run([python, "-c", SITE], check=True, capture_output=True, text=True).stdout.strip()
    (Path(own) / "torch_of_the_tests.pth").write_text(f"{there}\n")
    _install(python, "rllib", [])


def _project() -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return project


def _install(python: Path, extra: str, packages: list[str]) -> None:
    limits, wanted = ROOT / "configs" / "constraints-ray.txt", _project()["optional-dependencies"][extra]
    command = [python, "-m", "pip", "install", "-q", "-c", limits, *packages, *wanted]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the extra {extra!r} cannot be installed: {done.stderr.strip().splitlines()[-1]}")


def run_case(python: Path, module: str, case: str) -> None:
    """Run a case, a function of a module of tests/, with another interpreter; raise AssertionError if it fails."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    done = subprocess.run([python, "-m", module, case], env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
