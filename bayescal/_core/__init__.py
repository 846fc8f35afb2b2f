"""Foundations without knowledge of calibration: errors, JAX's set-up, files, text, time limits."""
