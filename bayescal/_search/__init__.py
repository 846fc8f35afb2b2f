"""Which effects are missing: structures, the walk over them, their posterior, the gate, channels."""
