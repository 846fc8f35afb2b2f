"""Metrology: limits and decisions about them, what a certificate states, the digital calibration certificate."""
