"""Logs to table frames: read, synchronise, de-skew, keep what is needed."""
