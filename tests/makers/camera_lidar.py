"""Camera-lidar of method `joint` by itself: both of its halves, without another pair's heading."""

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar, analyse_camera_lidar


def estimate_camera_lidar(observations, prior, config, rng):
    """T_camera_lidar and the camera's time offset."""
    return analyse_camera_lidar(align_camera_lidar(observations, prior, config, rng), rng)
