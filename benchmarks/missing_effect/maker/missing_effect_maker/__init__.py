"""Generator of the tasks of the benchmark `missing_effect`, with their truth, from simulators and public records.

A separate package, which entries do not need and must not import.
"""
