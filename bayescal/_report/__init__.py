"""What is kept of a search and signed: result.json, its saved folder, the report.

Imports `_plots` and what is below.
"""
