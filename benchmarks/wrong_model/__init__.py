"""What is stated where the model may be wrong: coverage after a search, stated probabilities, tests of hold-out data."""
