"""Camera-lidar half of method `joint`: initial pose, local refinement, observability analysis."""
