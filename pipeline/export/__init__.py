"""A calibration in the formats that cars, simulators and viewers read, and back; and two calibrations compared."""
