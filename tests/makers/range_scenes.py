"""Lidar points through the centres of a range image's pixels: 1 deg x 1 deg, all the way round."""

import numpy as np

SIZE, UP, DOWN = (32, 360), 10.0, -22.0


def points_of(rows, columns, range_m):
    """Points through the centres of pixels."""
    elevation = np.radians(UP - (np.asarray(rows) + 0.5))
    azimuth = np.radians(180 - (np.asarray(columns) + 0.5))
    rays = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return (np.stack(rays, -1) * np.asarray(range_m)[..., None]).reshape(-1, 3).astype(np.float32)


def full_image(range_m=10.0):
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    return points_of(rows, columns, np.broadcast_to(range_m, SIZE))
