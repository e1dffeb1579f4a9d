"""Time the flocking model of DECLARATION.md: the median of 100 runs of 100 steps, each with a seed of its own."""

from statistics import median
from time import perf_counter

import numpy as np
from flocking import LARGE, SMALL, flocking_model, run_model

RUNS = 100

for size, parameters in (("small", SMALL), ("large", LARGE)):
    scene = flocking_model(**parameters)
    run_model(scene, 0)  # compiles the kernel, once per machine
    times = []
    for seed in np.random.default_rng(42).integers(1, 10_001, RUNS):
        began = perf_counter()
        run_model(scene, int(seed))
        times.append(perf_counter() - began)
    print(f"flockenv Flocking-{size} (ms): {median(times) * 1e3}")
