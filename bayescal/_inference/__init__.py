"""Posterior of a model given readings: basis columns, inner products, modes, sampling, least squares, NUTS."""
