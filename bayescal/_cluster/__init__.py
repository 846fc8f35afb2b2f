"""Fleets: readings in partitions, each fitted by itself, here or on the workers of a Dask cluster.

A partition leaves one file of results, written whole or not at all and marked with a digest of what it was made from.
A run is what is left to do: partitions without such a file. Imports `_fleet` and what is below.
"""
