"""From a model and readings to a posterior: mode, closed-form integrals, importance sampling, chains.

Imports what is below it: `_core`, `_readings`, `_model`.
"""
