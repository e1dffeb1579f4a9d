"""The workbench: the players, what trains and tunes them, and the comparison; run from a checkout, not installed."""

import flockenv  # noqa: F401  # first of all: handles signals from here on, if this is a command

import os  # isort: skip

# Torch's threads spin for some milliseconds before they sleep: on two cores, where the worlds' second thread would run.
# This is a quarter of a millisecond, and after a forward pass a step of Flock takes 1 / 1.7 of the time.
# OpenMP reads it when torch is imported; a value that is already set stays.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
