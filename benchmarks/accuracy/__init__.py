"""Numerical accuracy: certified data, reference posteriors, coverage of intervals."""
