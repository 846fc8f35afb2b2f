"""The version: the build reads it here, and a test compares `CITATION.cff`."""

__version__ = "0.2.0"
