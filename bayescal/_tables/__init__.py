"""Reading of files as tables: unmatched headers and cells, and problems of files."""
