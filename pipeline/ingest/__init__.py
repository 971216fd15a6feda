"""From logs to table rows: read, synchronise, de-skew, keep only the needed data."""
