"""How readings were recorded, before any model: order in time, what is set aside, rounding, Allan deviation.

Imports `_core` and `_readings`.
"""
