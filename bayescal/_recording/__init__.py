"""How readings were recorded, before any model: order in time, what is set aside (clipped readings, spikes), rounding.

Imports `_core` and `_readings`.
"""
