"""The version, said once; `pyproject.toml` repeats it for the build, and a test compares them."""

__version__ = "0.2.0"
