"""Fleets on a cluster of this machine: how quick, how much memory, what is left of kills, populations, structures."""
