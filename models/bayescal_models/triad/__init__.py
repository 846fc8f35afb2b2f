"""Common parts of three-axis instruments: model equation, slots, effects on several axes, simulated poses."""
