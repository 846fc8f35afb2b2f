"""The worlds that tasks are made of: random numbers, noise, instruments. An entry may not import it."""
