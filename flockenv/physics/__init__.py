"""What acts on agents, how that is integrated, what a step must end with, and which agents live."""
