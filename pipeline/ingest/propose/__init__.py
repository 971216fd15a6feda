"""Proposal of a fleet.toml from logs: which topic is which sensor, and the meaning of its values."""
