"""Version number of the package; the build reads it, and a test compares it with `CITATION.cff`."""

__version__ = "0.2.0"
