"""Files in and out, units, checked columns: from a table to `Measurements`.

Imports `_core`.
"""
