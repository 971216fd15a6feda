"""Measurements as messages, messages as logs."""
