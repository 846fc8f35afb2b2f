"""Workbench: the calibration loop in a browser. All its actions are public functions of `bayescal`."""
