"""PySocialForce: the extended social force model in numpy, every pair of people."""

import math

from turns import Case, run


def crowd(people: int) -> Case:
    """A crowd, one person per square metre, all walking to the right; no groups, no obstacles."""
    import numpy as np
    import pysocialforce

    rng = np.random.default_rng(0)
    start = np.zeros((people, 6))  # position, velocity, goal
    start[:, :2] = rng.uniform(0, math.sqrt(people), (people, 2))
    start[:, 2] = 1.0
    start[:, 4:] = start[:, :2] + [1e6, 0.0]
    simulator = pysocialforce.Simulator(start)

    def step() -> None:
        simulator.step()
        simulator.peds.ped_states.clear()  # it keeps every past state, and would slow down as they pile up

    does = (
        f"extended social force model, one crowd of {people} people, 1 per m2 at first, float64: every pair, any "
        "distance, and the way to a goal; no groups, no walls, no observations, no rewards"
    )
    return Case(step, people, does)


if __name__ == "__main__":
    run({"crowd_100": lambda threads: crowd(100), "crowd_500": lambda threads: crowd(500)}, "pysocialforce", "numpy")
