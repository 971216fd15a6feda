"""Rigs drawn from a seed, so that networks do not learn one car by heart: every number within stated limits.

The limits are those of available sensors and their usual places on cars, not of one product. The number of
pixels and beams is limited so that a frame costs about as much as one of the rig `demo`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec
from pipeline.simulate.sensors.rig_spec import RigSpec, short_rig

__all__ = ["random_rig"]

_PIXELS: Final = (300_000, 520_000)
_PINHOLE_DEG: Final = (48.0, 84.0)  # wider lenses have no pinhole model
_F_THETA_DEG: Final = (80.0, 150.0)
_ASPECT: Final = (1.3, 3.4)  # width over height: 4:3 to a strip cut from the image
# Rows, the lowest and the highest elevation, azimuth to each side, step between columns.
_SPARSE_ROWS: Final = (16, 16, 20, 24, 32, 32, 40)
_DENSE_ROWS: Final = (48, 64, 64, 80, 96, 128)
_SPARSE_SHARE: Final = 0.5  # networks trained on dense lidars fail on 16 rings


def random_rig(seed: int) -> RigSpec:
    """The rig of a seed: lens, image, rows, resolutions, places, clocks and mounting errors are drawn."""
    rng = np.random.default_rng([seed, 61])
    even = rng.uniform

    def turned(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
        return float(even(-roll, roll)), float(even(-pitch, pitch)), float(even(-yaw, yaw))

    high = float(even(1.25, 2.4))  # of the camera: a car's mirror to a van's roof
    above = float(even(0.0, 0.5))
    in_grille = rng.random() < 0.6
    radar_xyz = (float(even(3.2, 3.8)), float(even(-0.4, 0.4)), float(even(0.4, 0.8)))
    if not in_grille:
        radar_xyz = (float(even(1.3, 1.8)), float(even(-0.3, 0.3)), high + float(even(-0.1, 0.3)))
    return short_rig(
        f"random-{seed}",
        _camera(rng),
        _lidar(rng),
        _radar(rng),
        xyz_m=(
            (float(even(1.2, 2.1)), float(even(-0.15, 0.15)), high),
            (float(even(0.9, 1.9)), float(even(-0.15, 0.15)), high + above),
            radar_xyz,
        ),
        rpy_deg=(turned(1.0, 3.0, 1.5), turned(1.0, 2.0, 1.5), turned(1.0, 1.5, 2.0)),
        delay_s=(float(even(-0.02, 0.03)), float(even(-0.03, 0.03))),
        sync_jitter_s=float(even(0.0005, 0.003)),
        prior_rotation_deg=float(even(0.5, 1.5)),
        prior_translation_m=float(even(0.01, 0.05)),
    )


def _camera(rng: np.random.Generator) -> CameraSpec:
    pinhole = rng.random() < 0.5
    across = float(rng.uniform(*(_PINHOLE_DEG if pinhole else _F_THETA_DEG)))
    aspect = float(rng.uniform(*_ASPECT))
    pixels = rng.uniform(*_PIXELS)
    width = 16 * round(np.sqrt(pixels * aspect) / 16)
    height = 2 * round(width / aspect / 2)
    share = height / width
    upright = (
        float(2 * np.degrees(np.arctan(share * np.tan(np.radians(across / 2)))))
        if pinhole
        else across * share
    )
    bent = rng.random() < 0.5
    k1 = float(rng.uniform(-0.25, 0.0)) if bent else 0.0
    return CameraSpec(
        width, height, across, upright,
        focal_error=float(rng.uniform(0.0, 0.002)),
        centre_error_px=float(rng.uniform(0.0, 1.0)),
        jpeg_quality=int(rng.integers(55, 96)),
        model="plumb_bob" if pinhole else "equidistant",
        # The second coefficient compensates most of the first one at the corners, as in real lenses.
        distortion=(k1, -0.3 * k1, 0.0, 0.0, 0.0) if pinhole else (0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip


def _lidar(rng: np.random.Generator) -> LidarSpec:
    sparse = rng.random() < _SPARSE_SHARE
    rows = int(rng.choice(_SPARSE_ROWS if sparse else _DENSE_ROWS))
    around = sparse and rng.random() < 0.5
    side = 180.0 if around else float(rng.uniform(32.0, 65.0))
    step = float(rng.uniform(0.2, 0.4))
    lowest, highest = float(rng.uniform(-25.0, -12.0)), float(rng.uniform(3.0, 15.0))
    return LidarSpec(
        (-side, side),
        (lowest, highest),
        columns=round(2 * side / step),
        rows=rows,
        sweep_s=float(rng.choice([0.05, 0.1])),
        min_range_m=float(rng.uniform(0.8, 5.0)),
        max_range_m=float(rng.uniform(70.0, 120.0)),
        range_sigma_m=float(rng.uniform(0.01, 0.03)),
        divergence_deg=float(rng.uniform(0.05, 0.15)),
    )


def _radar(rng: np.random.Generator) -> RadarSpec:
    return RadarSpec(
        azimuth_deg=float(rng.uniform(28.0, 60.0)),
        elevation_deg=float(rng.uniform(8.0, 15.0)),
        min_range_m=float(rng.uniform(1.0, 5.0)),
        max_range_m=float(rng.uniform(70.0, 120.0)),
        azimuth_resolution_deg=float(rng.uniform(1.0, 3.0)),
        elevation_resolution_deg=float(rng.uniform(3.0, 9.0)),
        range_resolution_m=float(rng.uniform(0.2, 0.6)),
        doppler_period_mps=float(rng.choice([10.4, 20.0, 40.0, 80.0])),
        doppler_positive=str(rng.choice(["receding", "approaching"])),
        rays=int(rng.integers(5000, 9000)),
    )
