"""Logs of autopilots and robots: PX4 ULog, ArduPilot's .bin, ROS bags, each read by its own library.

Imports `_core` alone: a log becomes plain columns here, and a table of readings in `_readings`.
"""
