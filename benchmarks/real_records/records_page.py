"""The page `docs/records_of_others.md`."""
from __future__ import annotations
def write(results): pass
