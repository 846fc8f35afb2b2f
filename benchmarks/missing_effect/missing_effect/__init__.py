"""An open benchmark for calibration: find the effects missing from an instrument's model, and state their probability.

An entry is one file with `solve(task)`; see README.md. Needs numpy, pandas and scipy.
"""

__version__ = "1.1.0"
