"""Which effects are missing, device by device, and which of them the devices of a fleet have in common."""
