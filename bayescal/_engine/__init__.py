"""The engine: the evidence of any structure, assembled from pieces that know no structure.

A structure is a set of effects and a noise law. Here stand the compiled pieces (an effect's columns, an instrument's
slopes), and what puts them together on the host: the linearised model, its closed-form evidence, the mode and draws.
Imports `_model` and what stands below it.
"""
