"""Presentation and storage of results: result.json, its folder, pictures, tables, the report."""
