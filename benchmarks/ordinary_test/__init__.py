"""The ordinary test: a few runs in a chamber, a body that lags behind the thermometer, and further hidden effects."""
