"""Is the calibration that a car uses still right? One log answers, axis by axis."""
