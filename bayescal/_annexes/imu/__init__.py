"""Calibration of three-axis sensors: logs, poses and moves, corrections, and files for other programs."""
