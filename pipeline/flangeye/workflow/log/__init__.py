"""A run on disk, as MCAP: recorded while it happens, read back, followed."""
