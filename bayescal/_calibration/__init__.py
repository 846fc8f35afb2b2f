"""Calibrations: the functions `fit`, `load`, `predict`, `check` and `compare`; draws with names, storage, guards."""
