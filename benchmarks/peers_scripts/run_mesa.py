"""Mesa: its own boid flockers, agent by agent in Python."""

import math

from turns import Case, run


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


if __name__ == "__main__":
    run({"boids_100": lambda threads: flockers(100), "boids_300": lambda threads: flockers(300)}, "mesa", "numpy")
