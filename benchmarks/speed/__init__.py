"""What answers cost in seconds and memory, beside peers in the same run on the same machine."""
