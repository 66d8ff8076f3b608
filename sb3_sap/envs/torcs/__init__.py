"""The reference simulator: TORCS' own physics, in the Python process."""
