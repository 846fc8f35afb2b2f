"""The instrument in use: its equation solved for the stimulus, the uncertainty budget, firmware.

Imports `_calibration`, `_diagnostics` and what is below.
"""
