"""Classes of lidar points by a range-image network, trained from the camera: samples, training, export."""
