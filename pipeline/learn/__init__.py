"""Calibration by self-supervised learning: data, networks, training, inference, the day's answer."""
