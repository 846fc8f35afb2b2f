"""Readings in partitions: which there are, how the devices of one are read, and the digest of what is done to them."""
