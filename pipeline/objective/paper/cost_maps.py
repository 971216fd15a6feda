"""Cost of projected points in the frames' cost maps, for many poses at once.

A cost map holds robust distance, sky penalty and other costs of a pixel, as one byte per pixel. The
four bytes that bilinear interpolation needs lie in one 32-bit word ("quad"), so a point costs one gather.
Points outside the image, or behind the camera, cost the out-of-view penalty.

By hand for the paper's methods: differential evolution evaluates 90 poses in each of 60 generations on 100 frames, for
Table 1 (`tests/benchmarks/studies/table1.py`) and for users of `--method pairwise-optimisation`.

Order of loops: frame, tile of points, pose, point. A tile stays in the L1 cache while all poses pass over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8, UInt32

from pipeline.objective.camera_lidar.projection_loops import camera_parameters, project_points
from pipeline.rig.cameras import Camera

__all__ = ["FoldedFrames", "fold_frames", "frame_costs", "pack_quads"]

_TILE = 2048  # points, 24 kB; 512 costs 4 % more
_f4 = np.float32
# 32-bit constants: plain ones would make numba compute in 64 bits and halve the width of its vectors.
_BYTE, _8, _16, _24 = np.uint32(255), np.uint32(8), np.uint32(16), np.uint32(24)
_31 = np.uint32(0x7FFFFFFF)  # says that an index is not negative: gathers of 32-bit offsets, 16 at a time


@dataclass(frozen=True, eq=False)
class FoldedFrames:
    """Points and cost maps of several frames, frame after frame."""

    xyz_m: Float32[np.ndarray, "3 N"]
    first: Int64[np.ndarray, " F1"]  # points of frame f: first[f]..first[f + 1]
    quads: UInt32[np.ndarray, " Q"]
    map_first: Int64[np.ndarray, " F"]
    size_px: Int32[np.ndarray, "F 2"]  # width, height
    step: Float32[np.ndarray, " F"]  # cost of one step of a byte
    cameras: tuple[Camera, ...]
    penalty: float

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.map_first)

    @cached_property
    def camera_parameters(self) -> Float32[np.ndarray, "F 18"]:
        """The cameras for compiled loops."""
        return np.array([camera_parameters(c) for c in self.cameras], _f4).reshape(-1, 18)

    @property
    def counts(self) -> Int64[np.ndarray, " F"]:
        """Points per frame."""
        return np.diff(self.first)


def pack_quads(bytes_map: UInt8[np.ndarray, "H W"]) -> UInt32[np.ndarray, "H W"]:
    """Each pixel's byte with those of its right, lower and lower right neighbour (0 beyond the border: no weight)."""
    q = bytes_map.astype(np.uint32)
    q[:, :-1] |= bytes_map[:, 1:].astype(np.uint32) << 8
    q[:-1] |= bytes_map[1:].astype(np.uint32) << 16
    q[:-1, :-1] |= bytes_map[1:, 1:].astype(np.uint32) << 24
    return q


def fold_frames(
    points: Sequence[Float[np.ndarray, "_ 3"]],
    costs: Sequence[Float[np.ndarray, "_ _"]],
    cameras: Sequence[Camera],
    penalty: float,
) -> FoldedFrames:  # fmt: skip
    """Lay out frames for `frame_costs`: points in the child frame [m], cost maps >= 0, scaled cameras.

    `penalty` is the cost of a point out of view or behind the camera.
    """
    quads, steps = [], []
    for cost, camera in zip(costs, cameras, strict=True):
        if cost.shape != (camera.height_px, camera.width_px):
            raise ValueError(f"map {cost.shape} does not fit camera {camera.height_px} x {camera.width_px}")
        steps.append(max(float(cost.max()), 1e-6) / 255)
        quads.append(pack_quads(np.round(cost / steps[-1]).astype(np.uint8)).ravel())
    first, map_first = (np.cumsum([0, *map(len, parts)]).astype(np.int64) for parts in (points, quads))
    return FoldedFrames(
        np.concatenate([np.zeros((0, 3)), *points]).T.astype(_f4, order="C"),
        first,
        np.concatenate([np.zeros(0, np.uint32), *quads]),
        map_first[:-1],
        np.array([[c.width_px, c.height_px] for c in cameras], np.int32).reshape(-1, 2),
        np.array(steps, _f4),
        tuple(cameras),
        penalty,
    )


def frame_costs(maps: FoldedFrames, T_camera_points: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
    """Sum of the costs of each frame's points at each pose."""
    out = np.zeros((len(T_camera_points), maps.frames))
    poses = np.ascontiguousarray(T_camera_points[:, :3, :], dtype=_f4).reshape(-1, 12)
    _add_costs(
        poses, maps.xyz_m, maps.first, maps.quads, maps.map_first, maps.size_px, maps.step, maps.camera_parameters,
        _f4(maps.penalty), out,
    )  # fmt: skip
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _add_costs(poses, xyz, first, quads, map_first, size_px, step, cameras, penalty, out):  # noqa: ANN001, ANN202
    us, vs = np.empty(_TILE, np.float32), np.empty(_TILE, np.float32)
    zero, one = _f4(0), _f4(1)
    for f in range(len(map_first)):
        width, height = size_px[f, 0], size_px[f, 1]
        quad = quads[map_first[f] : map_first[f] + width * height]
        w_max, h_max = _f4(width - 1), _f4(height - 1)
        outside = penalty / step[f]
        for t0 in range(first[f], first[f + 1], _TILE):
            t1 = min(t0 + _TILE, first[f + 1])
            for p in range(len(poses)):
                project_points(cameras[f], xyz, t0, t1, poses[p], one, us, vs)
                total = zero
                for i in range(t1 - t0):  # branch-free: gathers in vectors
                    u, v = us[i], vs[i]
                    uc = min(max(u, zero), w_max)
                    vc = min(max(v, zero), h_max)
                    iu, iv = np.int32(uc), np.int32(vc)
                    a, b = uc - _f4(iu), vc - _f4(iv)
                    w = quad[np.uint32(np.uint32(iv * width + iu) & _31)]
                    m0, m1 = _f4(np.int32(w & _BYTE)), _f4(np.int32((w >> _8) & _BYTE))
                    m2, m3 = _f4(np.int32((w >> _16) & _BYTE)), _f4(np.int32(w >> _24))
                    top = m0 + a * (m1 - m0)
                    bottom = m2 + a * (m3 - m2)
                    cost = top + b * (bottom - top)
                    total += outside if (u != uc) | (v != vc) else cost
                out[p, f] += total * step[f]
