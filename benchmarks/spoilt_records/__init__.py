"""Records with faults, as files from a laboratory have them: answered correctly, reported, or silently wrong."""
