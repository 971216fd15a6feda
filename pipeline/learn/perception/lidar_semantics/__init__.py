"""What lidar points are, by a small range-image network that learns from the camera: samples, training, export."""
