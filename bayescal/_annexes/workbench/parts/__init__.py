"""Widgets of the panes (style, text, buttons, rows) and their background tasks."""
