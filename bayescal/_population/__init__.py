"""What many devices have in common: a mean and a spread of each coefficient, from sums over the devices alone."""
