"""The command line: options in, text or JSON out, an exit status.

Imports any room; heavy modules load inside the commands.
"""
