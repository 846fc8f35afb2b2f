"""Thermal parameters of autopilots: what a calibration says, in the form that their firmware evaluates.

Imports `_compensation`, `_calibration` and what is below.
"""
