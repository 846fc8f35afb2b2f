"""Detection, confusion and false discovery of effects, in banks of simulated campaigns."""
