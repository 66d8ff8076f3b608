"""The reference simulator: TORCS' own physics, in process."""
