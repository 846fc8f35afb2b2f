"""Makes tasks of the benchmark `missing_effect`, with their truth: simulators, plan of an edition, public records.

A package of its own, which an entry has no need of and may not import.
"""
