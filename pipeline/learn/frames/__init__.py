"""Frames of a lake with their calibration for other people's networks: Parquet, nuScenes."""
