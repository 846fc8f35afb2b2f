"""Version number of the package, read by the build and compared with `CITATION.cff` by a test."""

__version__ = "0.2.0"
