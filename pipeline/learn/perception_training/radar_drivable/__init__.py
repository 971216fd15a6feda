"""The radar's drivable area by a small network that learns from the lidar: samples, training, export."""
