"""Statements under a misspecified model: coverage after a search, probabilities, tests of hold-out data."""
