"""Units of measurement."""

#: km/h that one m/s is.
KMH = 3.6
