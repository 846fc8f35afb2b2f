"""Channels of one unit, calibrated together: structure and noise for each, one body for all."""
