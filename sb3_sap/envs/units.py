"""Units of measurement."""

KMH = 3.6
"""km/h that one m/s is."""
