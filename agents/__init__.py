"""Training and tuning of players, and their comparison; run from a checkout, not installed."""

import flockenv  # noqa: F401  # first of all: handles signals from here on, if this is a command

import os  # isort: skip

# Torch's threads spin for some milliseconds before they sleep: on two cores they take the worlds' second core.
# With this value they spin for 0.25 ms, and a step of Flock after a forward pass takes 1 / 1.7 of the time.
# OpenMP reads it when torch is imported; a value that is already set stays.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
