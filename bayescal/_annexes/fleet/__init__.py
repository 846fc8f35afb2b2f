"""Many devices of one type: files split into devices, fits here or on Dask, searches, results."""
