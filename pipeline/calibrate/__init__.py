"""Stage calibrate: select, trigger, solve, verify; one folder for each, one per family of methods."""
