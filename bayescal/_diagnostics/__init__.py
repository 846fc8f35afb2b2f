"""Where a model fails, and which model predicts better.

Imports `_calibration` and what is below.
"""
