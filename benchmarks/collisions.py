"""The cost of hard collisions: `python -m benchmarks.collisions`.

Times a step of solid discs under each collision response, as a ratio to the same step without collisions. Two scenes: a
gas, whose discs cover a fifth of a torus, and a heap that rests on the floor of a box. Notes give the impacts per step.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import typer

from benchmarks.floors import machine, of_scene
from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line
from benchmarks.scenes import step_from_start
from flockenv.geometry.space import Box, Torus
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects import Gravity
from flockenv.scene import Group, Scene

__all__ = ["gas", "heap"]

RADIUS = 0.05
STEPS = 10
RESPONSES = ("project", "impulses", "back_up", "earliest")


def gas(count: int) -> tuple[Scene, State]:
    """Return a scene of elastic discs at 1 m/s that cover a fifth of a torus, and its state after 2 s."""
    edge = math.sqrt(count * math.pi * RADIUS**2 / 0.2)
    side = math.ceil(math.sqrt(count))
    spawn = Spawn(speed=(1.0, 1.0))
    scene = Scene(
        groups=(Group(count=count, radius=RADIUS, spawn=spawn),), space=Torus(size=(edge, edge)), dt=1 / 120,
        effects=(Gravity(acceleration=(0.0, 0.0)),), constraints=(Collisions(restitution=1.0),),
    )  # fmt: skip
    state = scene.start(0)
    lattice = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:count]
    state = state.with_motion((lattice + 0.5)[None] * edge / side, state.vel)
    return scene, scene.run(state, 240)


def heap(count: int) -> tuple[Scene, State]:
    """Return a scene of discs in a box 22 diameters wide, and its state after they have fallen for 2 s."""
    width = 22 * RADIUS * 2
    scene = Scene(
        groups=(Group(count=count, radius=RADIUS, spawn=Spawn(low=(0.0, 0.0), high=(1.0, 1.0))),),
        space=Box(size=(width, 10.0 + width * count / 200)), dt=1 / 480, effects=(Gravity(acceleration=(0.0, -9.81)),),
        constraints=(Collisions(response="impulses", restitution=0.2, friction=0.3, passes=60),),
    )  # fmt: skip
    place = np.arange(count)
    pos = np.stack([0.06 + 0.108 * (place % 20) + 0.004 * (place // 20 % 2), 0.055 + 0.105 * (place // 20)], 1)
    start = scene.start(0).with_motion(pos[None], np.zeros((1, count, 2)))
    return scene, scene.run(start, 960)


def main(
    count: Annotated[int, typer.Option(min=10, help="Number of discs.")] = 1000,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure steps with collisions, by response, as ratios to the same steps without."""
    with Bench("collisions", quick, rounds, out) as bench:
        most = machine(bench)
        for name, (scene, state) in (("gas", gas(count)), ("heap", heap(min(count, 300)))):
            discs, collisions = scene.agents, scene.constraints[0]
            bare = scene.model_copy(update={"constraints": ()})
            floor = most.floor(of_scene(bare, state, STEPS)) if most else None  # collisions are not counted
            pack = [Contestant("none", step_from_start(bare, state, STEPS), discs * STEPS, floor, f"{discs:,} discs")]
            for response in RESPONSES:
                kind = scene.model_copy(update={"constraints": (collisions.model_copy(update={"response": response}),)})
                after = kind.run(state, 60)
                hits = (after.count_of("impacts") - state.count_of("impacts")) / 60
                step, note = step_from_start(kind, state, STEPS), f"{hits:.3g} impacts a step"
                pack.append(Contestant(response, step, discs * STEPS, floor, note))
            for result in bench.race(f"{name} of {discs:,}", pack, baseline="none")[1:]:
                bench.note(f"{name}, {result.name}: {1e6 * discs / result.rate:,.0f} us per step of {discs:,} discs.")
        bench.note("One thread: a world is not divided among threads by collisions; worlds of a batch are.")


if __name__ == "__main__":
    command_line(main)()
