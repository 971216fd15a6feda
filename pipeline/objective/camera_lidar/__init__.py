"""Terms of camera-lidar: edges, reflectivity, mutual information, projected into image maps."""
