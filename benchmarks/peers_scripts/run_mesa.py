"""Mesa: its own boid flockers, agent by agent in Python."""

import math
from itertools import count

from turns import Case, run

STEPS = 100


def flockers(agents: int) -> Case:
    """Mesa's example as it comes (100 boids in 100 x 100, vision 10), at the same density for other numbers."""
    from mesa.examples.basic.boid_flockers.model import BoidFlockers

    edge = 100 * math.sqrt(agents / 100)
    model = BoidFlockers(population_size=agents, width=edge, height=edge, vision=10, separation=2, seed=0)
    does = (
        f"boid_flockers, one world x {agents} boids on a torus {edge:.0f} wide: separation (radius 2), alignment and "
        "cohesion (radius 10), one after the other in random order; no observations, no rewards"
    )
    return Case(model.step, agents, does)


def declared(birds: int, extent: float, visual_distance: float) -> Case:
    """Mesa's example under the numbers that the comparison of ABM frameworks declares: a new model and 100 steps."""
    from mesa.examples.basic.boid_flockers.model import BoidFlockers

    seeds = count()

    def run_model() -> None:
        model = BoidFlockers(
            population_size=birds, width=extent, height=extent, vision=visual_distance, separation=1, speed=1,
            cohere=0.03, separate=0.015, match=0.05, seed=next(seeds),
        )  # fmt: skip
        for _ in range(STEPS):
            model.step()

    does = f"boid_flockers, a new world of {birds} and {STEPS} steps; birds are updated one after the other"
    return Case(run_model, birds * STEPS, does)


if __name__ == "__main__":
    run(
        {
            "boids_100": lambda threads: flockers(100),
            "boids_300": lambda threads: flockers(300),
            "declared_small": lambda threads: declared(200, 100.0, 5.0),
            "declared_large": lambda threads: declared(400, 150.0, 15.0),
        },
        "mesa",
        "numpy",
    )
