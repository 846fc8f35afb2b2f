"""Effective draws per second: ours beside other samplers on the same log densities."""
