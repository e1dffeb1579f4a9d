"""flockenv beside C written by hand for this one purpose: `python -m benchmarks.limit`.

The C (limit.c, limit_kernel.h) knows three rules, a torus and semi-implicit Euler, and nothing else; it is compiled
here, by gcc -O3 -march=native. Every call of either side begins in the same state and does the same number of steps.
Before a race both do a few, and where they then disagree there is no race. One thread.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.floors import Machine, compile_sources, machine, of_scene
from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line, number
from benchmarks.scenes import crowd, restart_each_call, step_from_start, world
from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.jit.thread_pool import use_threads
from flockenv.model.state import State
from flockenv.physics.effects.effect import separation_directions
from flockenv.scene import Scene

__all__ = ["ROWS", "Reference", "Row", "disagreement"]

FEW = 5  # steps after which both sides are compared
CLOSE = {"float64": 1e-9, "float32": 1e-4}  # m, nearly all agents; a single neighbour more or less moves one by 1e-3
FAR = {"float64": 1e-9, "float32": 2e-2}  # m, all agents
NEARLY_ALL = 0.99


@dataclass(frozen=True)
class Row:
    """What both sides step."""

    title: str
    scene: Callable[[], Scene]
    steps: int  # per call
    worlds: int = 1


def _rows() -> Iterator[Row]:
    for dtype in ("float32", "float64"):
        for d in (2, 3):
            yield Row(f"1024 worlds x 32, {d}-D, {dtype}", lambda t=dtype, d=d: world(t, d), 10, 1024)
        for agents, d in ((10_000, 2), (100_000, 2), (1_000_000, 2), (100_000, 3)):
            yield Row(f"one world of {agents:,}, {d}-D, {dtype}", lambda n=agents, t=dtype, d=d: crowd(n, t, d), 10)
    yield Row("one world of 1,000,000, 2-D, float32, a step per call", lambda: crowd(1_000_000, "float32"), 1)


ROWS = tuple(_rows())


# --- the C side -----------------------------------------------------------------------------------------------------


class Reference:
    """The compiled reference and what it is given."""

    def __init__(self, limit: ctypes.CDLL) -> None:
        self.limit = limit
        limit.form.restype = ctypes.c_char_p
        self.form: str = limit.form().decode()  # which intrinsics it is written in here

    def stepper(self, scene: Scene, state: State, steps: int) -> Callable[[], object]:
        """Return a call that advances the arrays of `state` by a number of steps, in place."""
        kind = "worlds" if state.shape[0] > 1 else "crowd"
        step = getattr(self.limit, f"{kind}_{'f32' if scene.dtype == 'float32' else 'f64'}_{scene.dimension}d")
        numbers = np.array(_rule_numbers(scene), scene.dtype)
        sizes = (*state.shape[:2], steps) if kind == "worlds" else (state.shape[1], steps)
        apart = np.ascontiguousarray(separation_directions(state.shape[1], scene.dimension).T, scene.dtype)
        arguments = (*map(_pointer, (state.x, state.v, apart)), *map(ctypes.c_long, sizes), _pointer(numbers))
        return lambda numbers=numbers, apart=apart: step(*arguments)  # it keeps the memory of these


def _rule_numbers(scene: Scene) -> list[float]:
    """Return what limit_kernel.h calls `rules`, in its order."""
    effects = [e for e in scene.effects if isinstance(e, (Separation, Alignment, Cohesion))]
    group = scene.groups[0]
    radii, weights = [e.radius for e in effects], [e.weight for e in effects]
    assert len(effects) == 3 and group.max_force is not None and group.max_speed is not None
    return [scene.space.extent(scene.dimension)[0], *radii, *weights, group.max_force, group.max_speed, scene.dt]


def _pointer(array: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


# --- the races ------------------------------------------------------------------------------------------------------


def disagreement(scene: Scene, mine: State, theirs: State) -> tuple[float, float]:
    """Return how far apart the same agents are, m: nearly all of them, and the farthest."""
    apart = np.linalg.norm(scene.space.displacement(mine.pos, theirs.pos), axis=-1)
    return float(np.quantile(apart, NEARLY_ALL)), float(apart.max())


def _check_agreement(bench: Bench, row: Row, scene: Scene, start: State, by: Reference) -> bool:
    """Let both do a few steps from one state; say it where they are not in the same places then."""
    mine, theirs = start.copy(), start.copy()
    scene.step(mine, out=mine, steps=FEW)
    by.stepper(scene, theirs, FEW)()
    nearly, worst = disagreement(scene, mine, theirs)
    bench.extra.setdefault("disagreement_m", {})[row.title] = {"nearly_all": nearly, "worst": worst}
    if nearly <= CLOSE[scene.dtype] and worst <= FAR[scene.dtype]:
        return True
    bench.note(
        f"{row.title}: NOT RACED. After {FEW} steps both sides differ by {number(worst)} m "
        f"({NEARLY_ALL:.0%} of agents by up to {number(nearly)} m)"
    )
    return False


def _race(bench: Bench, row: Row, by: Reference | None, most: Machine | None) -> bool:
    """Race one row; False if both sides do not do the same."""
    scene = row.scene()
    start = scene.start(0, worlds=row.worlds)
    if by is not None and not _check_agreement(bench, row, scene, start, by):
        return False
    floor = most.floor(of_scene(scene, start, row.steps)) if most else None
    work = row.worlds * scene.agents * row.steps
    contestants = [Contestant("flockenv", step_from_start(scene, start, row.steps), work, floor)]
    if by is not None:
        theirs = start.copy()
        step = restart_each_call(start, theirs, by.stepper(scene, theirs, row.steps))
        contestants.insert(0, Contestant("C", step, work, floor))
    bench.race(row.title, contestants, baseline=contestants[0].name)
    return True


def main(
    only: Annotated[str, typer.Option(help="Rows whose title contains this, such as float32 or 1,000,000.")] = "",
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure flockenv beside hand-written C, and both beside a floor; refuse where they do not do the same."""
    use_threads(1)
    rows = [row for row in ROWS if only in row.title]
    if not rows:
        raise typer.BadParameter(f"--only {only!r}: in no title; titles: {'; '.join(row.title for row in ROWS)}")
    with Bench("limit", quick, rounds, out) as bench, compile_sources(bench, "limit") as libraries:
        by, most = Reference(libraries[0]) if libraries else None, machine(bench)
        same = [_race(bench, row, by, most) for row in rows]
        _note_remarks(bench, by)
    if not all(same):
        raise typer.Exit(1)


def _note_remarks(bench: Bench, by: Reference | None) -> None:
    """Say what a call does, what C is written in, and all ratios in one line."""
    bench.note(
        "One thread. Every call begins in the same state; 10 steps a call unless a row says otherwise. C keeps the "
        f"agents of a large world sorted from step to step of a call{f'; it is in {by.form}' if by else ''}."
    )
    ratios = [f"{r.race} {number(r.ratio)}" for r in bench.results if r.name == "flockenv" and r.ratio and by]
    if ratios:
        bench.note(f"flockenv's rate over that of C: {'; '.join(ratios)}.")


if __name__ == "__main__":
    command_line(main)()
