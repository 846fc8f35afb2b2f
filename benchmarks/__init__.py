"""Measurements of the library itself: how accurate, how fast. `python -m benchmarks NAME`."""
