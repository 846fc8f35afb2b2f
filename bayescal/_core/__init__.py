"""What everything stands on, and nothing of calibration: refusals, JAX's set-up, files, text, time limits."""
