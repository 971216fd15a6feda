"""Simulated rigs by name, and drawn from a seed.

Rigs are drawn so that networks do not learn one car by heart; limits are those of available sensors and their
usual places on cars. The number of pixels and beams is limited: a frame costs about as much as one of `demo`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.simulate.sensors.rig_spec import (
    CameraSpec,
    LidarSpec,
    RadarSpec,
    RigSpec,
    SensorSpec,
    Sheet,
    Triple,
)

__all__ = ["RIGS", "rig_named"]

RANDOM: Final = "random-"  # prefix of rigs drawn from a seed
PAIRS: Final = "-pairs"  # suffix of rigs whose cameras have another image before each moment
ROWS: Final = "rows-"  # `rows-32-60`: the rig demo with a lidar of 32 rows over 60 deg
# Half the pixels of the paper's camera, with a matching lidar and radar: sufficient for most purposes, and
# much faster.
_CAMERA, _LIDAR, _RADAR = CameraSpec(912, 470), LidarSpec(columns=160, rows=64), RadarSpec(rays=6000)
# All around, as on a roof: 0.4 deg by 1.3 deg.
_SPINNING: Final = LidarSpec((-180.0, 180.0), (-25.0, 15.0), 900, 32, 0.1, 0.8, 100.0)
# Steps of data sheets with 128 channels: 0.125 deg around the horizon, 0.5 deg above and below, 1 deg at the
# ends.
_STEPS_128: Final = ((-25, -14, 1), (-14, -7, 0.5), (-7, 3, 0.125), (3, 13, 0.5), (13, 15.5, 1))
_ROWS_128: Final = tuple(np.concatenate([np.arange(*map(float, step)) for step in _STEPS_128]).tolist())
_CORNER: Final = RadarSpec(azimuth_deg=60.0, azimuth_resolution_deg=3.2, rays=9000)
_CAMERA_M, _LIDAR_M, _LEVEL = (1.62, 0.02, 1.62), (1.50, 0.00, 1.80), (0.0, 0.0, 0.0)
_PAPER: Final = (CameraSpec(), LidarSpec(), RadarSpec())
_PIXELS: Final = (300_000, 520_000)
_PINHOLE_DEG: Final = (48.0, 84.0)  # wider lenses have no pinhole model
_F_THETA_DEG: Final = (80.0, 150.0)
_ASPECT: Final = (1.3, 3.4)  # width over height: 4:3 to a strip cut from the image
# Rows, the lowest and the highest elevation, azimuth to each side, step between columns.
_SPARSE_ROWS: Final = (16, 16, 20, 24, 32, 32, 40)
_DENSE_ROWS: Final = (48, 64, 64, 80, 96, 128)
_SPARSE_SHARE: Final = 0.5  # networks trained on dense lidars fail on 16 rings


# A delivery van with six cameras, two lidars and five radars, each with its own clock; and a subset, `duo`. The roof's
# lidar overlaps with every camera, cameras with their neighbours, and the rear corner radars with the rear cameras.
# Lens and pixels of surround cameras at about a third of their resolution; lens distortion is logged.
_VAN_SIDE: Final = CameraSpec(
    800, 500, 84.0, 58.7, model="plumb_bob", distortion=(-0.20, 0.05, 3e-4, -2e-4, -0.004)
)
_VAN_FRONT: Final = CameraSpec(912, 470)
_VAN_REAR: Final = CameraSpec(720, 540, 186.0, 139.5)
# 0.4 by 1.3 deg over 360 deg; a flash lidar in the grille that looks ahead, 120 by 25 deg.
_VAN_ROOF: Final = LidarSpec((-180.0, 180.0), (-25.0, 15.0), 900, 32, 0.1, 1.2, 100.0)
_VAN_GRILLE: Final = LidarSpec((-60.0, 60.0), (-12.5, 12.5), 300, 40, 0.05, 1.0, 90.0)
_VAN_NOSE: Final = RadarSpec(azimuth_deg=45.0, max_range_m=100.0, rays=7000)
_VAN_CORNER: Final = RadarSpec(
    azimuth_deg=70.0, azimuth_resolution_deg=3.2, min_range_m=1.0, max_range_m=70.0, rays=7000
)


def _van_camera(name: str, sheet: CameraSpec, xyz_m: Triple, yaw_deg: float, pitch_deg: float,
            delay_s: float) -> SensorSpec:  # fmt: skip
    return SensorSpec(name, sheet, xyz_m, (0.0, pitch_deg, yaw_deg), delay_s, 30.0)


_VAN: Final = RigSpec(
    "van",
    (
        _van_camera("front", _VAN_FRONT, (2.05, 0.02, 1.95), 0.0, 2.0, 0.012),
        _van_camera("left", _VAN_SIDE, (1.60, 0.98, 1.90), 70.0, 4.0, 0.009),
        _van_camera("right", _VAN_SIDE, (1.60, -0.98, 1.90), -70.0, 4.0, 0.015),
        _van_camera("rear_left", _VAN_SIDE, (1.40, 1.00, 1.90), 125.0, 4.0, 0.006),
        _van_camera("rear_right", _VAN_SIDE, (1.40, -1.00, 1.90), -125.0, 4.0, 0.011),
        _van_camera("rear", _VAN_REAR, (-0.95, 0.0, 1.75), 180.0, 10.0, 0.020),
        SensorSpec("top", _VAN_ROOF, (1.20, 0.0, 2.35), rate_hz=10.0),
        SensorSpec("grille", _VAN_GRILLE, (3.30, 0.05, 0.90), delay_s=-0.007, rate_hz=20.0),
        SensorSpec("nose", _VAN_NOSE, (3.40, -0.20, 0.55), delay_s=-0.018, rate_hz=14.0),
        SensorSpec("corner_fl", _VAN_CORNER, (3.15, 0.88, 0.60), (0.0, 0.0, 50.0), -0.025, 17.0),
        SensorSpec("corner_fr", _VAN_CORNER, (3.15, -0.88, 0.60), (0.0, 0.0, -50.0), -0.021, 17.0),
        SensorSpec("corner_rl", _VAN_CORNER, (-0.85, 0.90, 0.65), (0.0, 0.0, 135.0), -0.028, 17.0),
        SensorSpec("corner_rr", _VAN_CORNER, (-0.85, -0.90, 0.65), (0.0, 0.0, -135.0), -0.023, 17.0),
    ),
    behind_m=150.0,
)

# The same as most that drive themselves: positions measured to 1 cm, one clock for cameras and lidars.
_SURVEYED: Final = replace(
    _VAN.changed(lambda s: s if s.kind == "radar" else replace(s, delay_s=0.0)), name="van-surveyed", delay_sd_s=0.0,
    prior_translation_m=0.01, stated_translation_m=0.01, stamp_sigma_s=0.001, image_pairs=True,
)  # fmt: skip

# For the demo: as fast as a three-sensor rig.
_DUO_SHEETS: Final[dict[str, Sheet]] = {
    "front": CameraSpec(608, 312),
    "left": CameraSpec(480, 300, 84.0, 58.7, model="plumb_bob", distortion=_VAN_SIDE.distortion),
    "top": replace(_VAN_ROOF, columns=450),
    "nose": replace(_VAN_NOSE, rays=4000),
    "corner_fl": replace(_VAN_CORNER, rays=4000),
}
_DUO: Final = RigSpec("duo", tuple(replace(_VAN[name], sheet=sheet) for name, sheet in _DUO_SHEETS.items()))
# As most cars on the road have: cameras and radars alone.
_NO_LIDAR: Final = RigSpec(
    "no_lidar",
    tuple(_VAN[name] for name in ("front", "left", "right", "nose", "corner_fl", "corner_fr")),
    behind_m=150.0,
    image_pairs=True,
)


def _trio(
    name: str, camera: CameraSpec = _CAMERA, lidar: LidarSpec = _LIDAR, radar: RadarSpec = _RADAR, *,
    xyz_m: tuple[Triple, Triple, Triple] = (_CAMERA_M, _LIDAR_M, (1.66, -0.22, 1.58)),
    rpy_deg: tuple[Triple, Triple, Triple] = (_LEVEL,) * 3, delay_s: tuple[float, float] = (0.012, -0.018),
    free_hz: Triple | None = None, **car: Any,
) -> RigSpec:  # fmt: skip
    """A rig of three sensors named camera, lidar and radar, in this order in the arguments; by default the demo's.

    `delay_s` is of camera and radar; `free_hz` None = the lidar triggers both; `**car` are fields of RigSpec.
    """
    rates, delays = free_hz or (None,) * 3, (delay_s[0], 0.0, delay_s[1])
    rows = zip(
        ("camera", "lidar", "radar"), (camera, lidar, radar), xyz_m, rpy_deg, delays, rates, strict=True
    )
    return RigSpec(name, tuple(SensorSpec(*row) for row in rows), **car)


_ALL: Final = (
    _trio("paper", *_PAPER),
    # One clock without delays, as in the paper's car: required by methods without time offsets.
    _trio("paper-one-clock", *_PAPER, delay_s=(0.0, 0.0), delay_sd_s=0.0),
    # No common trigger: every sensor with its own rate and phase, as on most cars.
    _trio("paper-free", *_PAPER, free_hz=(30.0, 10.0, 13.0)),
    _trio("demo"),
    _trio(
        "ring16",
        lidar=LidarSpec((-180.0, 180.0), (-15.0, 15.0), 1800, 16, 0.1, 0.8, 100.0),
        radar=RadarSpec(rays=6000, doppler_period_mps=10.394, doppler_positive="approaching"),
    ),
    # Radars at the corners of the bumper look beyond the view of a forward lidar.
    _trio(
        "corner-left", lidar=_SPINNING, radar=_CORNER,
        xyz_m=(_CAMERA_M, _LIDAR_M, (3.60, 0.80, 0.60)), rpy_deg=(_LEVEL, _LEVEL, (0.0, 0.0, 45.0)),
    ),
    _trio(
        "corner-right", lidar=_SPINNING, radar=_CORNER,
        xyz_m=(_CAMERA_M, _LIDAR_M, (3.60, -0.80, 0.60)), rpy_deg=(_LEVEL, _LEVEL, (0.0, 0.0, -45.0)),
    ),
    _trio(
        "spin128",
        lidar=LidarSpec(
            (-180.0, 180.0), (-25.0, 15.0), 1200, 128, 0.1, 0.8, 120.0, row_elevation_deg=_ROWS_128
        ),
    ),
    # A narrow image strip and a 360 deg lidar of 64 rows, 1/3 deg apart above and 1/2 deg below.
    _trio(
        "hdl64",
        camera=CameraSpec(1242, 376, 81.4, 29.2, model="plumb_bob", distortion=(0.0,) * 5),
        lidar=LidarSpec(
            (-180.0, 180.0), (-24.3, 2.0), 1800, 64, 0.1, 0.9, 120.0,
            row_elevation_deg=(*np.arange(-24.3, -8.5, 0.5).tolist(), *np.linspace(-8.33, 2.0, 32).tolist()),
        ),
        xyz_m=((1.62, 0.06, 1.65), (1.35, 0.0, 1.73), (3.60, 0.0, 0.60)),
    ),
    # A lidar of 24 x 10 deg in the middle of an image of 150 deg, and a 360 deg lidar with an image of 32
    # deg.
    _trio(
        "keyhole",
        camera=CameraSpec(1024, 512, 150.0, 75.0),
        lidar=LidarSpec((-12.0, 12.0), (-7.0, 3.0), 160, 64, max_range_m=120.0),
    ),
    _trio(
        "telephoto",
        camera=CameraSpec(960, 540, 32.0, 18.3, model="plumb_bob", distortion=(0.0,) * 5),
        lidar=replace(_SPINNING, columns=1800),
    ),
    # 240,000 beams a second over 82 x 25 deg, as in Livox' Horizon; six lasers behind the same prisms.
    _trio(
        "rosette", lidar=LidarSpec((-41.0, 41.0), (-14.5, 10.5), 4000, 6, 0.1, 1.0, 100.0, pattern="rosette")
    ),
    _trio("fisheye", camera=CameraSpec(1280, 960, 190.0, 142.5), lidar=_SPINNING),
    _trio(
        "pinhole",
        camera=CameraSpec(
            1280, 720, 72.0, 44.5, model="plumb_bob", distortion=(-0.32, 0.11, 5e-4, -4e-4, -0.015)
        ),
    ),
    _trio("rolling", camera=replace(_CAMERA, readout_s=0.03)),
    # A cab: all sensors except the radar are high and look down.
    _trio(
        "truck", lidar=replace(_LIDAR, elevation_deg=(-21.0, 3.0)),
        xyz_m=((2.10, 0.10, 2.55), (1.90, 0.0, 3.00), (2.60, -0.15, 0.65)),
        rpy_deg=((0.0, 6.0, 0.0), _LEVEL, _LEVEL),
    ),
    _trio("bumper", xyz_m=(_CAMERA_M, _LIDAR_M, (3.70, 0.05, 0.50))),
    # Nose down, and twice as fast.
    _trio("tilted", lidar=replace(_LIDAR, sweep_s=0.04), rpy_deg=(_LEVEL, (0.0, 5.0, 0.0), _LEVEL)),
    _VAN,
    _SURVEYED,
    _DUO,
    _NO_LIDAR,
)  # fmt: skip
RIGS: Final = {rig.name: rig for rig in _ALL}
# Suffixes of rig names, and their changes of the radars. `-dirty` matches two real-like days by statistics
# that need no truth (study radar_dirt of 62eb5928).
_RADARS: Final[dict[str, dict[str, Any]]] = {
    "-flat": {"has_elevation": False},
    "-dirty": {"road_mirror": 0.3, "elevation_noise": 2.0},
}


def rig_named(name: str) -> RigSpec:
    """One of RIGS, `random-SEED` or `rows-ROWS-DEGREES`, perhaps with a suffix. ConfigError.

    `-flat` removes radar elevation, `-dirty` degrades it; `-pairs`, the last, gives cameras a second image.
    """
    if name.endswith(PAIRS):
        return replace(rig_named(name.removesuffix(PAIRS)), name=name, image_pairs=True)
    plain, change = name, None
    for ending, spoil in _RADARS.items():
        if name.endswith(ending):
            plain, change = name.removesuffix(ending), spoil
    seed = plain.removeprefix(RANDOM)
    base = random_rig(int(seed)) if plain != seed and seed.isdecimal() else RIGS.get(plain) or _by_rows(plain)
    if base is None:
        known = f"{', '.join(RIGS)}, {RANDOM}SEED, {ROWS}ROWS-DEGREES, each also with {' or '.join(_RADARS)} behind it"
        raise ConfigError("simulate", "rig", f"{name!r} is not one of {known}")
    return base if change is None else replace(base.changed(partial(_with_radar, change)), name=name)


def _by_rows(name: str) -> RigSpec | None:
    """The rig of a name that begins with ROWS, None of another name."""
    asked = name.removeprefix(ROWS).split("-")
    if not name.startswith(ROWS) or len(asked) != 2 or not all(part.isdecimal() for part in asked):
        return None
    rows, degrees = (int(part) for part in asked)
    # 32 rows are 1 deg apart; columns are 0.3 deg apart whatever the width.
    sheet = LidarSpec((-degrees / 2, degrees / 2), (-20.0, 11.0), round(degrees / 0.3), rows, 0.1, 0.8, 100.0)
    return _trio(name, lidar=sheet)


def _with_radar(change: dict[str, Any], sensor: SensorSpec) -> SensorSpec:
    return replace(sensor, sheet=replace(sensor.sheet, **change)) if sensor.kind == "radar" else sensor


def random_rig(seed: int) -> RigSpec:
    """The rig of a seed: lens, image, rows, resolutions, places, clocks and mounting errors are drawn."""
    rng = np.random.default_rng([seed, 61])
    even = rng.uniform

    def turned(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
        return even(-roll, roll), even(-pitch, pitch), even(-yaw, yaw)

    high = even(1.25, 2.4)  # of the camera: a car's mirror to a van's roof
    above = even(0.0, 0.5)
    in_grille = rng.random() < 0.6
    radar_xyz = (even(3.2, 3.8), even(-0.4, 0.4), even(0.4, 0.8))
    if not in_grille:
        radar_xyz = (even(1.3, 1.8), even(-0.3, 0.3), high + even(-0.1, 0.3))
    return _trio(
        f"random-{seed}",
        _camera(rng),
        _lidar(rng),
        _radar(rng),
        xyz_m=(
            (even(1.2, 2.1), even(-0.15, 0.15), high),
            (even(0.9, 1.9), even(-0.15, 0.15), high + above),
            radar_xyz,
        ),
        rpy_deg=(turned(1.0, 3.0, 1.5), turned(1.0, 2.0, 1.5), turned(1.0, 1.5, 2.0)),
        delay_s=(even(-0.02, 0.03), even(-0.03, 0.03)),
        sync_jitter_s=even(0.0005, 0.003),
        prior_rotation_deg=even(0.5, 1.5),
        prior_translation_m=even(0.01, 0.05),
    )


def _camera(rng: np.random.Generator) -> CameraSpec:
    pinhole = rng.random() < 0.5
    across = rng.uniform(*(_PINHOLE_DEG if pinhole else _F_THETA_DEG))
    aspect = rng.uniform(*_ASPECT)
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
    k1 = rng.uniform(-0.25, 0.0) if bent else 0.0
    return CameraSpec(
        width, height, across, upright,
        focal_error=rng.uniform(0.0, 0.002),
        centre_error_px=rng.uniform(0.0, 1.0),
        jpeg_quality=int(rng.integers(55, 96)),
        model="plumb_bob" if pinhole else "equidistant",
        # The second coefficient compensates most of the first one at the corners, as in real lenses.
        distortion=(k1, -0.3 * k1, 0.0, 0.0, 0.0) if pinhole else (0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip


def _lidar(rng: np.random.Generator) -> LidarSpec:
    sparse = rng.random() < _SPARSE_SHARE
    rows = int(rng.choice(_SPARSE_ROWS if sparse else _DENSE_ROWS))
    around = sparse and rng.random() < 0.5
    side = 180.0 if around else rng.uniform(32.0, 65.0)
    step = rng.uniform(0.2, 0.4)
    lowest, highest = rng.uniform(-25.0, -12.0), rng.uniform(3.0, 15.0)
    return LidarSpec(
        (-side, side), (lowest, highest), columns=round(2 * side / step), rows=rows,
        sweep_s=float(rng.choice([0.05, 0.1])), min_range_m=rng.uniform(0.8, 5.0),
        max_range_m=rng.uniform(70.0, 120.0), range_sigma_m=rng.uniform(0.01, 0.03),
        divergence_deg=rng.uniform(0.05, 0.15),
    )  # fmt: skip


def _radar(rng: np.random.Generator) -> RadarSpec:
    return RadarSpec(
        azimuth_deg=rng.uniform(28.0, 60.0), elevation_deg=rng.uniform(8.0, 15.0),
        min_range_m=rng.uniform(1.0, 5.0), max_range_m=rng.uniform(70.0, 120.0),
        azimuth_resolution_deg=rng.uniform(1.0, 3.0), elevation_resolution_deg=rng.uniform(3.0, 9.0),
        range_resolution_m=rng.uniform(0.2, 0.6),
        doppler_period_mps=float(rng.choice([10.4, 20.0, 40.0, 80.0])),
        doppler_positive=str(rng.choice(["receding", "approaching"])), rays=int(rng.integers(5000, 9000)),
    )  # fmt: skip
