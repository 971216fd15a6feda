"""Decoding of messages of every kind to plain arrays."""
