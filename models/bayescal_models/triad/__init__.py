"""Common parts of three-axis instruments: the equation, its slots, effects on several axes, and poses."""
