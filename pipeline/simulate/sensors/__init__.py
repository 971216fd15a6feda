"""Sensors of a vehicle and their measurements of the world."""
