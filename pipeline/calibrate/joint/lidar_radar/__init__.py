"""Lidar-radar half of method `joint`: search, registration, what the day determines."""
