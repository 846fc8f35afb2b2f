"""Conversion of tables to `Measurements` (headers, units, checks); averages, exclusion of spikes, Allan deviation."""
