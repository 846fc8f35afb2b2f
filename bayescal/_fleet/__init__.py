"""Many devices at once: stacks of equal shape, closed forms, what the devices have in common.

Imports `_calibration` and what is below.
"""
