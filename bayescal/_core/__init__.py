"""Foundations independent of calibration: errors, JAX's set-up, files, text, time limits."""
