"""Calibration of many devices of one type: files, fits (in this process or on Dask), searches for effects, results."""
