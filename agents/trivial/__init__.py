"""Players that ignore what they observe, or only brake: no benchmark may rank them near the rules."""
