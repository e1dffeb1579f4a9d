"""Studies of simulations: measures, accuracy, hard cases, validation, experiments, and records of their results."""
