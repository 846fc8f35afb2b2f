"""What everything stands on, and nothing of calibration: refusals, JAX's set-up, linear algebra, text.

Imports no other room.
"""
