"""Check of the calibration that a car uses now against one log, axis by axis."""
