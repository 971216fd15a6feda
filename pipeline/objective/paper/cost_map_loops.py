"""The loops behind `cost_maps`: scalar code, branch-free over points, that LLVM turns into vector gathers.

Long on purpose: everything that a point needs stays in registers. Arguments are those of `cost_maps.FoldedFrames`;
`out` [poses, frames] is added to.
"""
# numba infers the types of the arguments; annotations would only repeat FoldedFrames.
# ruff: noqa: ANN001, D103
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["pinhole_costs", "polynomial_costs"]

_TILE = 2048  # points, 24 kB; 512 costs 4 % more
_NEAR_M = 0.5  # nothing outside the car is nearer
_f4 = np.float32
# 32-bit constants: plain ones would make numba compute in 64 bits and halve the width of its vectors.
_BYTE, _8, _16, _24 = np.uint32(255), np.uint32(8), np.uint32(16), np.uint32(24)
_31 = np.uint32(0x7FFFFFFF)  # says that an index is not negative: gathers of 32-bit offsets, 16 at a time

_jit = numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")


@no_type_check  # keeps the tests' shape checks out of compiled code
@_jit
def pinhole_costs(poses, xs, ys, zs, first, quads, map_first, size_px, camera, penalty, out) -> None:
    one, near, zero = _f4(1), _f4(_NEAR_M), _f4(0)
    for f in range(len(map_first)):
        width, height = size_px[f, 0], size_px[f, 1]
        quad = quads[map_first[f] : map_first[f] + width * height]
        w_max, h_max = _f4(width - 1), _f4(height - 1)
        fx, fy, cx, cy, scale = camera[f, 0], camera[f, 1], camera[f, 2], camera[f, 3], camera[f, 5]
        outside = penalty / scale
        for t0 in range(first[f], first[f + 1], _TILE):
            t1 = min(t0 + _TILE, first[f + 1])
            xt, yt, zt = xs[t0:t1], ys[t0:t1], zs[t0:t1]
            for p in range(len(poses)):
                r0, r1, r2, tx = poses[p, 0], poses[p, 1], poses[p, 2], poses[p, 3]
                r3, r4, r5, ty = poses[p, 4], poses[p, 5], poses[p, 6], poses[p, 7]
                r6, r7, r8, tz = poses[p, 8], poses[p, 9], poses[p, 10], poses[p, 11]
                total = zero
                for i in range(len(xt)):
                    z = r6 * xt[i] + r7 * yt[i] + r8 * zt[i] + tz
                    iz = one / max(z, near)
                    u = (r0 * xt[i] + r1 * yt[i] + r2 * zt[i] + tx) * iz * fx + cx
                    v = (r3 * xt[i] + r4 * yt[i] + r5 * zt[i] + ty) * iz * fy + cy
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
                    total += outside if (z < near) | (u != uc) | (v != vc) else cost
                out[p, f] += total * scale


@no_type_check  # keeps the tests' shape checks out of compiled code
@_jit
def polynomial_costs(poses, xs, ys, zs, first, quads, map_first, size_px, camera, penalty, out) -> None:
    # One long body: LLVM turns the loop over points into vector code only where nothing in it is a call.
    one, zero, tiny = _f4(1), _f4(0), _f4(1e-6)
    for f in range(len(map_first)):
        width, height = size_px[f, 0], size_px[f, 1]
        quad = quads[map_first[f] : map_first[f] + width * height]
        w_max, h_max = _f4(width - 1), _f4(height - 1)
        fx, fy, cx, cy, c_min, scale = (
            camera[f, 0],
            camera[f, 1],
            camera[f, 2],
            camera[f, 3],
            camera[f, 4],
            camera[f, 5],
        )
        k0, k1, k2, k3, k4 = camera[f, 6], camera[f, 7], camera[f, 8], camera[f, 9], camera[f, 10]
        k5, k6, k7, k8 = camera[f, 11], camera[f, 12], camera[f, 13], camera[f, 14]
        outside = penalty / scale
        for t0 in range(first[f], first[f + 1], _TILE):
            t1 = min(t0 + _TILE, first[f + 1])
            xt, yt, zt = xs[t0:t1], ys[t0:t1], zs[t0:t1]
            for p in range(len(poses)):
                r0, r1, r2, tx = poses[p, 0], poses[p, 1], poses[p, 2], poses[p, 3]
                r3, r4, r5, ty = poses[p, 4], poses[p, 5], poses[p, 6], poses[p, 7]
                r6, r7, r8, tz = poses[p, 8], poses[p, 9], poses[p, 10], poses[p, 11]
                total = zero
                for i in range(len(xt)):
                    x = r0 * xt[i] + r1 * yt[i] + r2 * zt[i] + tx
                    y = r3 * xt[i] + r4 * yt[i] + r5 * zt[i] + ty
                    z = r6 * xt[i] + r7 * yt[i] + r8 * zt[i] + tz
                    inv = one / np.sqrt(x * x + y * y + z * z + tiny)
                    c = z * inv
                    q = one - max(c, c_min)
                    k = k0 + q * (
                        k1 + q * (k2 + q * (k3 + q * (k4 + q * (k5 + q * (k6 + q * (k7 + q * k8))))))
                    )
                    u = x * inv * k * fx + cx
                    v = y * inv * k * fy + cy
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
                    total += outside if (c < c_min) | (u != uc) | (v != vc) else cost
                out[p, f] += total * scale
