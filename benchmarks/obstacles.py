"""What steering around many obstacles costs: `python -m benchmarks.obstacles`.

2,000 agents under `avoid_obstacles`, another behaviour, or hard collisions, among 1 to 10,000 obstacles, one per
25 m^2, or in 3-D per 125 m^3. Every call does ten steps from the same beginning. What a step of an agent costs with
many shapes, against what it costs with ten.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line
from benchmarks.scenes import step_from_start
from flockenv.behaviours import AvoidObstacles, FollowWall, ForceField, Whiskers
from flockenv.geometry.shapes import Block, Capsule, Circle, Shape
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions
from flockenv.physics.effects.effect import Effect
from flockenv.scene import Group, Scene

__all__ = ["agents_among_obstacles"]

AGENTS, STEPS = 2_000, 10
COUNTS = (1, 4, 10, 100, 1_000, 10_000)
APART = 5.0  # m, between obstacles
FEWEST = 10  # obstacles that the plane has room for: with fewer, the same agents are in the same plane

Kind = Literal["block", "capsule", "circle"]
BEHAVIOURS: dict[str, Effect] = {
    "avoid_obstacles": AvoidObstacles(weight=8),
    "whiskers": Whiskers(weight=8),
    "force_field": ForceField(weight=8, range=2),
    "follow_wall": FollowWall(weight=3, distance=0.5),
}


def agents_among_obstacles(
    count: int, kind: Kind = "block", dtype: str = "float64", dimension: int = 2, behaviour: str = "avoid_obstacles"
) -> Scene:
    """Return agents among a number of obstacles that lie near the points of a square or cubic lattice.

    behaviour: one of BEHAVIOURS, or collisions: agents that do not steer, and bounce off obstacles.
    """
    side, rows = APART * max(count, FEWEST) ** (1 / dimension), math.ceil(round(count ** (1 / dimension), 9))
    rng = np.random.default_rng(1)
    obstacles = []
    for place in itertools.islice(itertools.product(range(rows), repeat=dimension), count):
        centre = (np.array(place) + 0.5 + rng.uniform(-0.2, 0.2, dimension)) * side / rows
        obstacles.append(_obstacle(kind, centre, rng))
    agents = Group(
        count=AGENTS, radius=0.2, max_speed=2, max_force=10,
        spawn=Spawn(low=(0,) * dimension, high=(side,) * dimension, speed=(1.5, 2)),
    )  # fmt: skip
    effects = (BEHAVIOURS[behaviour],) if behaviour in BEHAVIOURS else ()
    constraints = () if behaviour in BEHAVIOURS else (Collisions(agents=False),)
    return Scene(
        dimension=dimension, groups=(agents,), obstacles=tuple(obstacles), effects=effects, constraints=constraints,
        dt=0.02, dtype=dtype,
    )  # fmt: skip


def _obstacle(kind: Kind, centre: NDArray[np.float64], rng: np.random.Generator) -> Shape:
    """Return an obstacle about 1 m wide."""
    at = tuple(centre.tolist())
    if kind == "block":
        return Block(centre=at, size=(1.0, 0.6, 0.8)[: len(at)], turn=rng.uniform(0, 90))
    if kind == "capsule":
        return Capsule(start=at, end=tuple((centre + (1.0, 0.5, 0.2)[: len(at)]).tolist()), radius=0.1)
    return Circle(centre=at, radius=0.5)


def main(
    kind: Annotated[Kind, typer.Option(help="Kind of the obstacles; circle: spheres in 3-D.")] = "block",
    dtype: Annotated[Literal["float32", "float64"], typer.Option(help="Precision of the scene.")] = "float64",
    dimension: Annotated[int, typer.Option(min=2, max=3, help="2 or 3.")] = 2,
    behaviour: Annotated[
        Literal["avoid_obstacles", "whiskers", "force_field", "follow_wall", "collisions"],
        typer.Option(help="What agents do."),
    ] = "avoid_obstacles",
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure agent-steps per second among 1 to 10,000 obstacles, as ratios to 10 of them."""
    with Bench("obstacles", quick, rounds, out) as bench:
        contestants = []
        for count in COUNTS:
            scene = agents_among_obstacles(count, kind, dtype, dimension, behaviour)
            call = step_from_start(scene, scene.start(0), STEPS)
            contestants.append(Contestant(f"{count:,}", call, AGENTS * STEPS, note=f"{count:,} x {kind}"))
        bench.race(f"{AGENTS:,} agents among obstacles, {behaviour}", contestants, baseline="10")
        bench.note(f"{dimension}-D, {dtype}, one obstacle per {APART**dimension:g} m^{dimension}, one thread")


if __name__ == "__main__":
    command_line(main)()
