"""The flocking model of the comparison of ABM frameworks, ours beside Mesa's: `python -m benchmarks.abm_comparison`.

The model is that of Flocking/DECLARATION.md in JuliaDynamics/ABMFrameworksComparison: 100 steps of 200 birds within 100
x 100 that see 5 far (small), or of 400 within 150 x 150 that see 15 far (large). `release/abm` has what we contribute
there, and its file is what is measured here. Frameworks that need Julia, NetLogo or MASON are not run.

Mesa is installed by `python -m benchmarks.peers --install mesa`. A turn is a whole run: a new model and its 100 steps.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.measure import Bench, Out, Quick, Result, Rounds, command_line
from benchmarks.peers import CACHE, DONE, PeerError, python_of, start_script

STEPS = 100
BIRDS = {"small": 200, "large": 400}
ELSEWHERE = ("Agents.jl", "NetLogo", "MASON")


def main(
    cache: Annotated[Path, typer.Option(help="Folder of the virtual environments of peers.")] = CACHE,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure the declared flocking model, small and large, by Mesa and by flockenv in turns, a core each."""
    mesa = cache.expanduser() / "mesa"
    if not (mesa / DONE).is_file():
        raise typer.BadParameter("mesa: not installed; python -m benchmarks.peers --install mesa")
    with Bench("abm_comparison", quick, rounds, out) as bench:
        for size in BIRDS:
            try:
                _measure(bench, size, python_of(mesa))
            except PeerError as error:
                bench.note(str(error))
        bench.extra["milliseconds"] = {f"{r.race}, {r.name}": _milliseconds(r) for r in bench.results}
        bench.note(f"Not run here: {', '.join(ELSEWHERE)}. Median times: {'; '.join(map(_sentence, bench.results))}.")


def _measure(bench: Bench, size: str, python: Path) -> None:
    """Measure one size; a run that is one of 100 worlds in a batch is a contestant of its own."""
    case, seconds = f"declared_{size}", 0.1
    ours = Path(sys.executable), "run_ours.py"
    with (
        start_script("mesa", python, "run_mesa.py", case, 1, seconds) as theirs,
        start_script("flockenv", *ours, case, 1, seconds) as one,
        start_script("flockenv, 100 worlds", *ours, f"{case}_100", 1, seconds) as many,
    ):
        bench.race(size, [theirs, one, many], baseline="mesa")


def _milliseconds(result: Result) -> float:
    """Return the median time of one run of one model, ms."""
    return 1e3 * BIRDS[result.race] * STEPS / result.rate


def _sentence(result: Result) -> str:
    return f"{result.race}, {result.name}: {_milliseconds(result):.3g} ms"


if __name__ == "__main__":
    command_line(main)()
