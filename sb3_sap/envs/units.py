"""Units of measurement."""

#: km/h per m/s.
KMH = 3.6
