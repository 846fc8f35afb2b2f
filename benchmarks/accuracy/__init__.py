"""How right the numbers are: certified data, reference posteriors, coverage of intervals."""
