"""Benchmarks of the library's accuracy, search and speed: `python -m benchmarks NAME`."""
