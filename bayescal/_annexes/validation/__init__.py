"""Validation on one's own installation: clauses of standards that the package answers, with certified values."""
