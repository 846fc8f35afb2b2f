"""The ordinary test: a few runs through a chamber, a body that lags, and whatever else is hidden."""
