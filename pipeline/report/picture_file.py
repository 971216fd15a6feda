"""A picture of one frame as a file: a still of prior and result side by side, or one that moves between them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import ConfigError
from pipeline.report.overlays import Extrinsics, Scene, Window, front_view, lidar_view, lidar_window
from pipeline.rig.se3 import exp_se3, inverse, log_se3, rotation_angle_rad

__all__ = ["between", "write_picture"]

_WIDTH_PX = 960
_STEPS = 16
_STEP_MS, _FIRST_MS, _LAST_MS = 70, 1200, 2200  # long enough at both ends to look around
# Of 100; dots stay sharp, and a sweep of a 1.8 Mpx camera stays below 1.5 MB.
_WEBP_QUALITY = 50
_MOVING = {".webp": (cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY), ".gif": ()}
_STILL = {".jpg": (cv2.IMWRITE_JPEG_QUALITY, 85), ".png": ()}


def between(before: Extrinsics, after: Extrinsics, share: float) -> Extrinsics:
    """The state between the two: share 0 is `before`, 1 is `after`, with each pair interpolated along its own screw."""
    pairs = zip(vars(before).values(), vars(after).values(), strict=True)
    return Extrinsics(*(exp_se3(share * log_se3(T @ inverse(T_before))) @ T_before for T_before, T in pairs))


def write_picture(
    out: Path, scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str]
) -> Path:
    """Write the scene's camera image with lidar and moving radar at two states, with labels.

    .jpg and .png are stills, `before` left and `after` right; .webp and .gif move between the two. The
    folder is created.

    Raises:
        ConfigError: another suffix.
    """
    kind = out.suffix.lower()
    if kind not in _MOVING | _STILL:
        known = ", ".join(_STILL | _MOVING)
        raise ConfigError("command line", "picture", f"{out.name} ends in none of {known}")
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind in _STILL:
        written = cv2.imwrite(str(out), front_view(scene, before, after, labels), _STILL[kind])
    else:
        written = cv2.imwriteanimation(str(out), _animation(scene, before, after), _MOVING[kind])
    if not written:
        raise OSError(f"{out} could not be written")
    return out


def _animation(scene: Scene, before: Extrinsics, after: Extrinsics) -> cv2.Animation:
    # Starts and ends slowly, so that the eye can follow a silhouette.
    shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _STEPS))
    window = lidar_window(scene, after)
    animation = cv2.Animation()
    animation.frames = [_drawn(scene, between(before, after, float(s)), after, window) for s in shares]
    animation.durations = [_FIRST_MS, *[_STEP_MS] * (_STEPS - 2), _LAST_MS]
    return animation


def _drawn(scene: Scene, state: Extrinsics, after: Extrinsics, window: Window) -> UInt8[np.ndarray, "H W 3"]:
    angle_deg, shift_m = _distance(state.T_camera_lidar, after.T_camera_lidar)
    label = f"camera-lidar: {angle_deg:.2f} deg, {100 * shift_m:.0f} cm from the result"
    image = lidar_view(scene, state, window, label)
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    return cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)


def _distance(T: Float[np.ndarray, "4 4"], T_other: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """Angle [deg] and shift [m] between two poses."""
    angle = float(np.degrees(rotation_angle_rad(T_other @ inverse(T))))
    return angle, float(np.linalg.norm(T_other[:3, 3] - T[:3, 3]))
