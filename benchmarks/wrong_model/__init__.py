"""What is stated where the model may be wrong: coverage after a search, probabilities, tests of hold-out data."""
