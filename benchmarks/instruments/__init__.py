"""What calibration makes of each instrument, beside customary estimates and published figures."""
