"""Pictures of calibrations and searches, offered as `bayescal.plot`.

Imports the rooms of results below.
"""
