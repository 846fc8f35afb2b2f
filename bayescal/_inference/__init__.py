"""From a model and readings to a posterior: columns, products, modes, sampling, least squares, NUTS."""
