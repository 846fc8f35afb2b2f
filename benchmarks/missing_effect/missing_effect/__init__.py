"""An open benchmark for calibration: find the effect that the model of an instrument lacks, and say how sure you are.

An entry is one file with `solve(task)`; see README.md. Needs numpy, pandas and scipy.
"""

__version__ = "1.1.0"
