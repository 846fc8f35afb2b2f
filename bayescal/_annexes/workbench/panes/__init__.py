"""Panes of the page: model, residuals, candidate effects, and tabs with the errors of all steps."""
