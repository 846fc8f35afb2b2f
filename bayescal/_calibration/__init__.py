"""What a fit is: the verbs `fit`, `load` and `predict`; draws with names, their tree, their storage.

Imports `_numpyro`, `_inference` and what is below.
"""
