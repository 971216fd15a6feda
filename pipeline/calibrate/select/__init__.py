"""Which frames calibrate, which judge, and whether a calibration is due."""
