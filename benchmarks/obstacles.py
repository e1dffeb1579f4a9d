"""What steering around many obstacles costs: `python -m benchmarks.obstacles`.

2,000 agents under `avoid_obstacles` among 1 to 1,000 obstacles, one per 25 m^2. Every call does ten steps from the same
beginning. What a step of an agent costs with many shapes, against what it costs with ten.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
import typer

from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line
from benchmarks.scenes import step_from_start
from flockenv.behaviours import AvoidObstacles
from flockenv.geometry.shapes import Block, Capsule, Circle, Shape
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene

__all__ = ["agents_among_obstacles"]

AGENTS, STEPS = 2_000, 10
COUNTS = (1, 4, 10, 100, 1_000)
APART = 5.0  # m, between obstacles
FEWEST = 10  # obstacles that the plane has room for: with fewer, the same agents are in the same plane


def agents_among_obstacles(count: int, kind: str = "block", dtype: str = "float64") -> Scene:
    """Return agents among a number of obstacles, in the plane, that lie near the points of a square lattice."""
    side, rows = APART * math.sqrt(max(count, FEWEST)), math.ceil(math.sqrt(count))
    rng = np.random.default_rng(1)
    obstacles: list[Shape] = []
    for k in range(count):
        x, y = ((np.array(divmod(k, rows)) + 0.5 + rng.uniform(-0.2, 0.2, 2)) * side / rows).tolist()
        if kind == "block":
            obstacles.append(Block(centre=(x, y), size=(1.0, 0.6), turn=rng.uniform(0, 90)))
        elif kind == "capsule":
            obstacles.append(Capsule(start=(x, y), end=(x + 1, y + 0.5), radius=0.1))
        else:
            obstacles.append(Circle(centre=(x, y), radius=0.5))
    agents = Group(
        count=AGENTS, radius=0.2, max_speed=2, max_force=10,
        spawn=Spawn(low=(0, 0), high=(side, side), speed=(1.5, 2)),
    )  # fmt: skip
    return Scene(
        groups=(agents,), obstacles=tuple(obstacles), effects=(AvoidObstacles(weight=8),), dt=0.02, dtype=dtype
    )


def main(
    kind: Annotated[Literal["block", "capsule", "circle"], typer.Option(help="Kind of the obstacles.")] = "block",
    dtype: Annotated[Literal["float32", "float64"], typer.Option(help="Precision of the scene.")] = "float64",
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure agent-steps per second among 1 to 1,000 obstacles, as ratios to 10 of them."""
    with Bench("obstacles", quick, rounds, out) as bench:
        contestants = []
        for count in COUNTS:
            scene = agents_among_obstacles(count, kind, dtype)
            call = step_from_start(scene, scene.start(0), STEPS)
            contestants.append(Contestant(f"{count:,}", call, AGENTS * STEPS, note=f"{count:,} x {kind}"))
        bench.race(f"{AGENTS:,} agents among obstacles", contestants, baseline="10")
        bench.note(f"{dtype}, one obstacle per {APART**2:g} m^2, one thread")


if __name__ == "__main__":
    command_line(main)()
