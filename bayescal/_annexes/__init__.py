"""Annexes: what is built on the core and stands beside it. The core imports none of them (`_core/annex.py`)."""
