"""The workbench: the players, what trains and tunes them, and the comparison; run from a checkout, not installed."""
