"""Simulators of the tasks: random numbers, noise, instruments. Entries must not import them."""
