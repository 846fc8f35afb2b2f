"""Validation of an installation: examples of standards and NIST data sets, compared with certified values."""
