"""Edges of the rig beyond camera, lidar and radar in pairs: to the vehicle frame, and between two lidars."""
