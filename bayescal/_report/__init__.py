"""Presentation and storage of results: result.json, the result folder, plots, tables, the report."""
