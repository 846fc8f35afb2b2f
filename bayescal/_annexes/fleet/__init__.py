"""Many devices of one type: reading files, fitting (locally or on Dask), searching for effects, and results."""
