"""Validation of an installation: clauses of standards, computed and compared with certified values."""
