"""The contents of a world: state, groups of agents, initial positions, networks, appearance."""
