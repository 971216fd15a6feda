"""Terms of the radar: registration to the lidar, the camera's boxes, moving clusters."""
