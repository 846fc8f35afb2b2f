"""A user's own NumPyro program: its sites read from a trace, Gaussian ones integrated out.

Imports `_inference` and what is below.
"""
