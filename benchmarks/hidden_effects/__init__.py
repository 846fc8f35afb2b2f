"""Which effects are found, told apart and invented, in banks of simulated campaigns."""
