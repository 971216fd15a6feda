"""Frames of a lake with their calibration for other people's networks: shards, Parquet, KITTI, nuScenes."""
