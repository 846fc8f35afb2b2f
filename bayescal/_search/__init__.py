"""Search for missing effects: structures, beam search, their posterior, acceptance checks, channels."""
