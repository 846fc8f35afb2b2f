"""Shipped entries, one file with `solve(task)` each, with the settings that the methods' documentation recommends."""
