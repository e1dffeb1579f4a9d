"""All pairs, or groups that are far away: `python -m benchmarks.gravitation`.

The exact sum over all pairs against the tree, at an opening of 0.5, over the number of agents, in flat space and in
three dimensions. Both run in turns. From the crossover follows flockenv.geometry.barnes_hut.MOST_DIRECT, up to which a
scene sums exactly; here the tree is grown for fewer too.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

from benchmarks.floors import Machine, machine, of_scene
from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line, number
from benchmarks.scenes import step_from_start
from flockenv.geometry.barnes_hut import MOST_DIRECT
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Gravitation
from flockenv.scene import Group, Scene

__all__ = ["AGENTS", "cloud"]

AGENTS = (500, 1_000, 2_000, 4_000, 8_000, 16_000)
OPENING = 0.5


def cloud(agents: int, dimension: int, dtype: str, opening: float) -> Scene:
    """Return agents in a unit square or cube; gravitation is too weak to move them noticeably during a benchmark."""
    spawn = Spawn(low=(0.0,) * dimension, high=(1.0,) * dimension)
    scene = Scene(
        dimension=dimension, groups=(Group(count=agents, spawn=spawn),), dt=1e-3, dtype=dtype,
        effects=(Gravitation(constant=1e-9, softening=0.01, opening=opening),),
    )  # fmt: skip
    vars(scene)["parts"] = dataclasses.replace(scene.parts, crowded=True)  # a tree whatever their number
    return scene


def _contestant(agents: int, dimension: int, dtype: str, opening: float, most: Machine | None) -> Contestant:
    """Return a scene stepped once a call."""
    scene = cloud(agents, dimension, dtype, opening)
    start = scene.start(0)
    pairs = scene.step(start).count_of("pairs") / agents
    note = f"each meets {number(pairs)} of {agents:,}"
    name = f"{agents:,}, {'tree' if opening else 'direct'}"
    floor = most.floor(of_scene(scene, start)) if most else None
    return Contestant(name, step_from_start(scene, start, 1), agents, floor, note)


def _compare(bench: Bench, dimension: int, dtype: str, largest: int, most: Machine | None) -> None:
    """Race the two at every size, and say where they cross."""
    ratios = {}
    for agents in (n for n in AGENTS if n <= largest):
        pair = [_contestant(agents, dimension, dtype, opening, most) for opening in (0.0, OPENING)]
        results = bench.race(f"{agents:,} agents, {dimension}-D, {dtype}", pair, baseline=pair[0].name)
        ratios[agents] = results[1].ratio
    text = "; ".join(f"{agents:,} {number(ratio)}" for agents, ratio in ratios.items() if ratio)
    bench.extra.setdefault("tree_over_direct", {})[f"{dimension}-D {dtype}"] = ratios
    bench.note(f"{dimension}-D, {dtype}, how many times faster the tree is than the exact sum: {text}.")


def main(
    single: Annotated[bool, typer.Option("--single", help="Also in float32.")] = False,
    largest: Annotated[int, typer.Option(min=AGENTS[0], help="Largest number of agents in a world.")] = AGENTS[-1],
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure the exact sum and the tree side by side."""
    with Bench("gravitation", quick, rounds, out) as bench:
        most = machine(bench)
        for dtype in ("float64", "float32") if single else ("float64",):
            for dimension in (2, 3):
                _compare(bench, dimension, dtype, largest, most)
        bench.note(f"Opening {OPENING:g}. A scene sums exactly up to {MOST_DIRECT:,} agents.")


if __name__ == "__main__":
    command_line(main)()
