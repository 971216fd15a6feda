"""Camera models of ROS CameraInfo: plumb_bob, rational_polynomial, equidistant (Kannala-Brandt).

Optical frame: x right, y down, z forward [m]; pixels: u right, v down, (0, 0) = centre of the first pixel.

Source: OpenCV calib3d "Detailed description" (pinhole, rational) and "Fisheye camera model" (Kannala and
Brandt 2006, eq. 6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from schemas.captures import CameraColumns

__all__ = ["CAMERA_MODELS", "Camera", "camera_of"]

CAMERA_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_MIN_DEPTH_M = 0.05  # closer than any object that a car's camera sees; bounds 1/z


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera.

    Args:
        K: camera matrix [px]; skew is not supported.
        D: distortion in ROS order: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1..k4 for equidistant. Empty = none.
        width_px: image width that K refers to.
    """

    model: str
    K: np.ndarray
    D: np.ndarray
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        if self.model not in CAMERA_MODELS:
            raise ValueError(f"camera model {self.model!r} is not one of {', '.join(CAMERA_MODELS)}")
        allowed = (0, 4) if self.model == "equidistant" else (0, 4, 5, 8)
        if len(self.D) not in allowed:
            raise ValueError(f"{self.model} takes {allowed} distortion coefficients, not {len(self.D)}")
        if not (np.all(np.isfinite(self.K)) and self.K[0, 0] > 0 and self.K[1, 1] > 0):
            raise ValueError(f"camera matrix needs positive focal lengths: {self.K.tolist()}")

    @property
    def focal_px(self) -> tuple[float, float]:
        """(fx, fy)."""
        return float(self.K[0, 0]), float(self.K[1, 1])

    @property
    def centre_px(self) -> tuple[float, float]:
        """(cx, cy)."""
        return float(self.K[0, 2]), float(self.K[1, 2])

    def scaled(self, scale: float) -> Camera:
        """The same camera with images `scale` times as large (pixel centres at integers)."""
        K = self.K.astype(np.float64).copy()
        K[:2, :2] *= scale
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
        return replace(
            self, K=K, width_px=round(self.width_px * scale), height_px=round(self.height_px * scale)
        )

    @cached_property
    def max_angle_rad(self) -> float:
        """Angle from the optical axis up to which the model is one-to-one (radius grows with angle)."""
        limit = np.pi if self.model == "equidistant" else np.arctan(20.0)
        theta = np.linspace(0.0, limit * 0.999, 4000)
        radius = self._radius(theta)
        falling = np.flatnonzero(np.diff(radius) <= 0)
        return float(theta[falling[0]] if falling.size else theta[-1])

    def project(
        self, points_camera: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
        """Pixels of points, and a mask that is False for invalid ones.

        Invalid points are behind the camera or outside the angle up to which the model is one-to-one.
        """
        x, y, z = points_camera.astype(np.float64).reshape(-1, 3).T
        if self.model == "equidistant":
            valid, xd, yd = self._equidistant(x, y, z)
        else:
            valid, xd, yd = self._pinhole(x, y, z)
        fx, fy, cx, cy = self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2]
        batch = points_camera.shape[:-1]
        return np.stack([fx * xd + cx, fy * yd + cy], -1).reshape(*batch, 2), valid.reshape(batch)

    def contains(
        self, uv: Float[np.ndarray, "*batch 2"], margin_px: float = 0.0
    ) -> Bool[np.ndarray, "*batch"]:
        """True for pixels inside the image and at least `margin_px` from its border."""
        u, v = uv[..., 0], uv[..., 1]
        m = margin_px - 0.5
        return (u >= m) & (v >= m) & (u <= self.width_px - 1 - m) & (v <= self.height_px - 1 - m)

    def unproject(self, uv: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit rays in the optical frame through pixels; NaN if the model has no ray through the pixel."""
        flat = uv.astype(np.float64).reshape(-1, 2)
        xd = (flat[:, 0] - self.K[0, 2]) / self.K[0, 0]
        yd = (flat[:, 1] - self.K[1, 2]) / self.K[1, 1]
        equidistant = self.model == "equidistant"
        rays = self._unproject_equidistant(xd, yd) if equidistant else self._unproject_pinhole(xd, yd)
        return rays.reshape(*uv.shape[:-1], 3)

    def fast_polynomial(self, degree: int = 9) -> tuple[Float[np.ndarray, " P"], float]:
        """Polynomial k(c) with `u = cx + fx k x/|p|`, `v = cy + fy k y/|p|`, c = z/|p|; largest error [px].

        Coefficients are in ascending order of power. For `equidistant` only: replaces atan2 in hot loops by a
        polynomial over the angles in the image.
        """
        if self.model != "equidistant":
            raise ValueError("the polynomial path is for equidistant cameras")
        corners = np.array(
            [[0.0, 0.0], [self.width_px, 0], [0, self.height_px], [self.width_px, self.height_px]]
        )
        rays = self.unproject(corners)
        reach = np.arccos(np.nanmin(rays[..., 2])) if np.isfinite(rays).any() else self.max_angle_rad
        theta = np.linspace(1e-6, min(1.1 * reach, self.max_angle_rad), 2000)
        k = self._radius(theta) / np.sin(theta)
        fit = np.polynomial.Polynomial.fit(np.cos(theta), k, degree).convert()
        error_px = float(np.max(np.abs(fit(np.cos(theta)) - k) * np.sin(theta)) * max(self.focal_px))
        return fit.coef, error_px

    # -- models
    # ------------------------------------------------------------------------------------------------------

    @cached_property
    def _coefficients(self) -> np.ndarray:
        d = np.zeros(8)
        d[: len(self.D)] = self.D
        return d

    def _radius(self, theta: np.ndarray) -> np.ndarray:
        """Distorted radius (in focal lengths) at an angle from the axis, without tangential terms."""
        d = self._coefficients
        if self.model == "equidistant":
            t2 = theta * theta
            return theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3]))))
        r = np.tan(theta)
        return r * self._radial(r * r)[0]

    def _radial(self, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radial factor and its derivative by r^2."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        n, dn = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * k3 * r2)
        m, dm = 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + 3 * k6 * r2)
        return n / m, (dn * m - n * dm) / (m * m)

    def _pinhole(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        safe = np.maximum(z, _MIN_DEPTH_M)
        a, b = x / safe, y / safe
        valid = (z > _MIN_DEPTH_M) & (np.hypot(a, b) <= np.tan(self.max_angle_rad))
        if not len(self.D):
            return valid, a, b
        xd, yd = self._distort(a, b)
        return valid, xd, yd

    def _distort(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p1, p2 = self._coefficients[2:4]
        r2 = a * a + b * b
        radial, _ = self._radial(r2)
        return a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * radial + p1 * (
            r2 + 2 * b * b
        ) + 2 * p2 * a * b

    def _distort_jacobian(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        p1, p2 = self._coefficients[2:4]
        radial, slope = self._radial(a * a + b * b)
        cross = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
        return np.stack(
            [
                np.stack([radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a, cross], -1),
                np.stack([cross, radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a], -1),
            ],
            -2,
        )

    def _unproject_pinhole(self, xd: np.ndarray, yd: np.ndarray) -> np.ndarray:
        a, b = xd.copy(), yd.copy()
        if len(self.D):
            for _ in range(20):  # Newton; converges in about 5 steps inside the valid radius
                ex, ey = self._distort(a, b)
                J = self._distort_jacobian(a, b)
                step = np.linalg.solve(J, np.stack([ex - xd, ey - yd], -1)[..., None])[..., 0]
                a, b = a - step[..., 0], b - step[..., 1]
            ex, ey = self._distort(a, b)
            bad = (np.hypot(ex - xd, ey - yd) > 1e-9) | (np.hypot(a, b) > np.tan(self.max_angle_rad))
            a, b = np.where(bad, np.nan, a), np.where(bad, np.nan, b)
        ray = np.stack([a, b, np.ones_like(a)], -1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def _equidistant(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        h = np.hypot(x, y)
        theta = np.arctan2(h, z)
        norm = np.sqrt(h * h + z * z)
        k = np.where(
            h > 1e-9 * norm, self._radius(theta) / np.where(h > 0, h, 1.0), 1 / np.where(norm > 0, norm, 1.0)
        )
        return (theta <= self.max_angle_rad) & (norm > _MIN_DEPTH_M), k * x, k * y

    def _unproject_equidistant(self, xd: np.ndarray, yd: np.ndarray) -> np.ndarray:
        radius = np.hypot(xd, yd)
        theta = np.minimum(radius, self.max_angle_rad)
        d = self._coefficients
        for _ in range(20):  # Newton on the monotonic radius
            t2 = theta * theta
            slope = 1 + t2 * (3 * d[0] + t2 * (5 * d[1] + t2 * (7 * d[2] + t2 * 9 * d[3])))
            theta = np.clip(theta - (self._radius(theta) - radius) / slope, 0.0, self.max_angle_rad)
        theta = np.where(np.abs(self._radius(theta) - radius) > 1e-9, np.nan, theta)
        s = np.where(radius > 1e-12, np.sin(theta) / np.where(radius > 1e-12, radius, 1.0), 1.0)
        return np.stack([s * xd, s * yd, np.cos(theta)], -1)


def camera_of(row: CameraColumns) -> Camera:
    """The camera of a row, at the size of the full image; raises ValueError if the columns are invalid."""
    return Camera(row.camera_model, row.camera_K, row.camera_D, row.image_width_px, row.image_height_px)
