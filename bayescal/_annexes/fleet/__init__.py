"""Many devices of one type: stacks, partitions, runs here or on Dask, populations, searches, results."""
