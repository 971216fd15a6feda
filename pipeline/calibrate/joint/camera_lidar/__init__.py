"""Camera-lidar half of method `joint`: initialise, refine, what the day determines."""
