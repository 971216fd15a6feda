"""Lidar-radar half of method `joint`: search, registration, observability."""
