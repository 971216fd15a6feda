"""Method `joint`: camera-lidar, lidar-radar and camera-radar by direct optimisation, each by its own data."""
