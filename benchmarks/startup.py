"""How soon a new process makes its first step: `python -m benchmarks.startup`.

Processes start one after another, in turns: one that does nothing, one that imports what flockenv needs, one that calls
an empty kernel of numba's besides (from the disk, as ours are), and one that makes an environment and steps it once.
Measured is from before the process is started until its first step is done, or whatever stands in its place. Nothing is
compiled but once, beforehand; so is bytecode, into a folder of its own, whatever PYTHONDONTWRITEBYTECODE says.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import time
from typing import Annotated

import gymnasium
import typer

import flockenv  # noqa: F401  # registers the environments
from benchmarks.measure import ROOT, Bench, Contestant, Out, Quick, Rounds, Sample, command_line, number

__all__ = ["Process"]

NEEDS = "import gymnasium, numba, numpy, pettingzoo, pydantic"
KERNEL = """
import numba

@numba.njit(cache=True)
def nothing(x):
    return x
"""
STEP = "import gymnasium, flockenv; env = gymnasium.make({!r}); env.reset(seed=0); env.step(env.action_space.sample())"
SAID = "; import time; print(time.time())"


@dataclass(frozen=True)
class Process(Contestant):
    """A new process for every call, until it says what time it is."""

    code: str = ""
    variables: Mapping[str, str] = field(default_factory=dict)

    def warm(self, seconds: float) -> int:
        """Start it once, so that everything is compiled and on the disk."""
        self.sample(1)
        return 1

    def sample(self, calls: int) -> Sample:
        """Start it a number of times; the time that it takes to end is not counted."""
        took = 0.0
        for _ in range(calls):
            began = time()
            done = subprocess.run(
                [sys.executable, "-c", self.code + SAID], env=dict(self.variables), capture_output=True, text=True
            )
            if done.returncode:
                raise RuntimeError(f"{self.name}: {done.stderr.strip().splitlines()[-1]}")
            took += float(done.stdout.split()[-1]) - began
        return Sample(calls, took)


def main(
    env_id: Annotated[str, typer.Argument(help="Id of the environment.")] = "flockenv/Pursuit-v0",
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure how soon a new process makes its first step, beside what it imports and what numba takes."""
    if env_id not in gymnasium.registry:
        raise typer.BadParameter(f"{env_id!r}: unknown; `flockenv list` lists them")
    with (
        tempfile.TemporaryDirectory() as folder,
        Bench("startup", quick, rounds, out, unit="first steps/s", scale=1.0) as bench,
    ):
        Path(folder, "flockenv_nothing.py").write_text(KERNEL, encoding="utf-8")
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        path = os.pathsep.join((str(ROOT), folder))
        variables = {**kept, "PYTHONPATH": path, "PYTHONPYCACHEPREFIX": str(Path(folder, "bytecode"))}
        codes = {
            "nothing": "pass",
            "imports": NEEDS,
            "imports, numba's kernel": f"{NEEDS}; from flockenv_nothing import nothing; nothing(1.0)",
            env_id: STEP.format(env_id),
        }
        contestants = [Process(name, lambda: None, 1, code=code, variables=variables) for name, code in codes.items()]
        results = bench.race("until the first step of a process", contestants, baseline=contestants[-2].name)
        text = "; ".join(f"{r.name} {number(1 / r.rate)} ({number(1 / r.quartiles[2])}-{number(1 / r.quartiles[0])})"
                         for r in results)  # fmt: skip
        bench.note(f"Seconds: {text}.")


if __name__ == "__main__":
    command_line(main)()
