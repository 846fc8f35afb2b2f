"""Metrology: decisions on conformity to limits, certificate data, and the digital calibration certificate (DCC)."""
