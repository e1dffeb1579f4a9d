"""Players that plan with the simulator: they see the state of the world, which no other player does."""
