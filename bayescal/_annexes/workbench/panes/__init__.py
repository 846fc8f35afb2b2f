"""Panes of the workbench page: model, residuals, candidate effects, and tabs with the errors of all search steps."""
