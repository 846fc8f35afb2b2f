"""Entries that are shipped: each one file with `solve(task)`, with the settings that its authors' documentation has."""
