"""A delivery van with six cameras, two lidars and five radars, each with its own clock; and a subset, `duo`.

The sensors cover all directions: the roof lidar overlaps with every camera, cameras overlap their neighbours,
and the rear corner radars overlap with the rear cameras.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from pipeline.simulate.sensors.data_sheets import CameraSpec, LidarSpec, RadarSpec
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec, Sheet

__all__ = ["DUO", "VAN"]

# Lens and pixels of surround cameras at about a third of their resolution; lens distortion is logged.
_SIDE: Final = CameraSpec(
    800, 500, 84.0, 58.7, model="plumb_bob", distortion=(-0.20, 0.05, 3e-4, -2e-4, -0.004)
)
_FRONT: Final = CameraSpec(912, 470)
_FISHEYE: Final = CameraSpec(720, 540, 186.0, 139.5)
# 0.4 by 1.3 deg over 360 deg; a flash lidar in the grille that looks ahead, 120 by 25 deg.
_ROOF: Final = LidarSpec((-180.0, 180.0), (-25.0, 15.0), 900, 32, 0.1, 1.2, 100.0)
_GRILLE: Final = LidarSpec((-60.0, 60.0), (-12.5, 12.5), 300, 40, 0.05, 1.0, 90.0)
_LONG: Final = RadarSpec(azimuth_deg=45.0, max_range_m=100.0, rays=7000)
_CORNER: Final = RadarSpec(
    azimuth_deg=70.0, azimuth_resolution_deg=3.2, min_range_m=1.0, max_range_m=70.0, rays=7000
)


def _camera(name: str, sheet: CameraSpec, xyz_m: tuple[float, float, float], yaw_deg: float, pitch_deg: float,
            delay_s: float) -> SensorSpec:  # fmt: skip
    return SensorSpec(name, sheet, xyz_m, (0.0, pitch_deg, yaw_deg), delay_s, 30.0)


VAN: Final = RigSpec(
    "van",
    (
        _camera("front", _FRONT, (2.05, 0.02, 1.95), 0.0, 2.0, 0.012),
        _camera("left", _SIDE, (1.60, 0.98, 1.90), 70.0, 4.0, 0.009),
        _camera("right", _SIDE, (1.60, -0.98, 1.90), -70.0, 4.0, 0.015),
        _camera("rear_left", _SIDE, (1.40, 1.00, 1.90), 125.0, 4.0, 0.006),
        _camera("rear_right", _SIDE, (1.40, -1.00, 1.90), -125.0, 4.0, 0.011),
        _camera("rear", _FISHEYE, (-0.95, 0.0, 1.75), 180.0, 10.0, 0.020),
        SensorSpec("top", _ROOF, (1.20, 0.0, 2.35), rate_hz=10.0),
        SensorSpec("grille", _GRILLE, (3.30, 0.05, 0.90), delay_s=-0.007, rate_hz=20.0),
        SensorSpec("nose", _LONG, (3.40, -0.20, 0.55), delay_s=-0.018, rate_hz=14.0),
        SensorSpec("corner_fl", _CORNER, (3.15, 0.88, 0.60), (0.0, 0.0, 50.0), -0.025, 17.0),
        SensorSpec("corner_fr", _CORNER, (3.15, -0.88, 0.60), (0.0, 0.0, -50.0), -0.021, 17.0),
        SensorSpec("corner_rl", _CORNER, (-0.85, 0.90, 0.65), (0.0, 0.0, 135.0), -0.028, 17.0),
        SensorSpec("corner_rr", _CORNER, (-0.85, -0.90, 0.65), (0.0, 0.0, -135.0), -0.023, 17.0),
    ),
    behind_m=150.0,
)

# For the demo: as fast as a three-sensor rig.
_SMALL: Final[dict[str, Sheet]] = {
    "front": CameraSpec(608, 312),
    "left": CameraSpec(480, 300, 84.0, 58.7, model="plumb_bob", distortion=_SIDE.distortion),
    "top": replace(_ROOF, columns=450),
    "nose": replace(_LONG, rays=4000),
    "corner_fl": replace(_CORNER, rays=4000),
}
DUO: Final = RigSpec("duo", tuple(replace(VAN[name], sheet=sheet) for name, sheet in _SMALL.items()))
