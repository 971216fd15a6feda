"""Errors against the truth, from a simulator or reflector targets, and the paper's tables."""
