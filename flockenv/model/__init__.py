"""What a world holds: its state, its groups of agents, where they begin, networks, and how they are drawn."""
