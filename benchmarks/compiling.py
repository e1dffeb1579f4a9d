"""What each replacement in numba saves of a cold compile: `python -m benchmarks.compiling [SCENE.yaml]`.

New processes, one after another and in turns, compile the step of a scene into an empty cache: with all replacements of
`flockenv.jit.numba_patches.front_end` and `flockenv.jit.numba_patches.lowering`, without one of them, without any.
Measured are seconds of the processor from the first call on.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.measure import ROOT, Bench, Contestant, Out, Quick, Rounds, Sample, command_line
from flockenv.jit.numba_patches.front_end import LEFT_OUT, PATCHES

__all__ = ["Compilation"]

SCENE = ROOT / "configs" / "scenes" / "boids.yaml"

CODE = """
import sys, time
from flockenv.scene.yaml_io import load_scene

scene = load_scene(sys.argv[1])
state = scene.start(0)
began = time.process_time()
scene.run(state, 1)
print(time.process_time() - began)
"""


@dataclass(frozen=True)
class Compilation(Contestant):
    """A new process for every call, with a cache of its own."""

    scene: Path = Path()
    left_out: str = ""

    def warm(self, seconds: float) -> int:
        """Nothing can be warmed up."""
        return 1

    def sample(self, calls: int) -> Sample:
        """Compile the scene `calls` times."""
        took = 0.0
        for _ in range(calls):
            with tempfile.TemporaryDirectory() as folder:
                variables = {**os.environ, "FLOCKENV_CACHE": folder, LEFT_OUT: self.left_out, "PYTHONPATH": str(ROOT)}
                command = [sys.executable, "-c", CODE, str(self.scene)]
                done = subprocess.run(command, env=variables, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(f"{self.name}: {done.stderr.strip().splitlines()[-1]}")
            took += float(done.stdout)
        return Sample(calls, took)


def main(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.yaml", exists=True)] = SCENE,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure what each replacement in numba saves of a cold compile."""
    titles = [*(each.title for each in PATCHES), "lowering"]
    with Bench("compiling", quick, rounds, out, unit="compiles/s", scale=1.0) as bench:
        contestants = [Compilation("all replacements", lambda: None, 1, scene=scene)]
        contestants += [Compilation(f"without {t}", lambda: None, 1, scene=scene, left_out=t) for t in titles]
        contestants.append(Compilation("without any", lambda: None, 1, scene=scene, left_out="all"))
        bench.race(f"cold compile of {scene.name}", contestants, baseline="all replacements")


if __name__ == "__main__":
    command_line(main)()
