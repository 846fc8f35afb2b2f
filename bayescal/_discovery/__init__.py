"""Which effect is missing: candidates, the search and its path, the next experiment.

Imports `_diagnostics` and what is below.
"""
