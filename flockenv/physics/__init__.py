"""Physics: effects on agents, integrators, constraints at the end of a step, births and deaths."""
