"""Panes of the page: the model, its residuals, candidate effects, and below them the error and the tabs."""
