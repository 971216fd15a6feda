"""The loops behind `kernels`: scalar code, branch-free over points, that LLVM turns into vector gathers.

Long on purpose: everything that a point needs stays in registers. Arguments are those of
`kernels.FoldedFrames`; `out` is (poses, frames) for costs and (poses, frames, 28) for gradients: cost, 6 of
the gradient, 21 of the upper triangle of the Gauss-Newton matrix.
"""
# numba infers the types of the arguments; annotations would only repeat FoldedFrames.
# ruff: noqa: ANN001, D103, PLR0915
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["pinhole_costs", "pinhole_gradients", "polynomial_costs", "polynomial_gradients"]

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


@no_type_check  # keeps the tests' shape checks out of compiled code
@_jit
def pinhole_gradients(poses, xs, ys, zs, first, quads, map_first, size_px, camera, penalty, out) -> None:
    one, two, zero, near = _f4(1), _f4(2), _f4(0), _f4(_NEAR_M)
    for f in range(len(map_first)):
        width, height = size_px[f, 0], size_px[f, 1]
        quad = quads[map_first[f] : map_first[f] + width * height]
        w_max, h_max = _f4(width - 1), _f4(height - 1)
        fx, fy, cx, cy, scale = camera[f, 0], camera[f, 1], camera[f, 2], camera[f, 3], camera[f, 5]
        for t0 in range(first[f], first[f + 1], _TILE):
            t1 = min(t0 + _TILE, first[f + 1])
            xt, yt, zt = xs[t0:t1], ys[t0:t1], zs[t0:t1]
            for p in range(len(poses)):
                r0, r1, r2, tx = poses[p, 0], poses[p, 1], poses[p, 2], poses[p, 3]
                r3, r4, r5, ty = poses[p, 4], poses[p, 5], poses[p, 6], poses[p, 7]
                r6, r7, r8, tz = poses[p, 8], poses[p, 9], poses[p, 10], poses[p, 11]
                s = g0 = g1 = g2 = g3 = g4 = g5 = zero
                h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
                h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
                for i in range(len(xt)):
                    x = r0 * xt[i] + r1 * yt[i] + r2 * zt[i] + tx
                    y = r3 * xt[i] + r4 * yt[i] + r5 * zt[i] + ty
                    z = r6 * xt[i] + r7 * yt[i] + r8 * zt[i] + tz
                    iz = one / max(z, near)
                    xn, yn = x * iz, y * iz
                    u, v = xn * fx + cx, yn * fy + cy
                    uc = min(max(u, zero), w_max)
                    vc = min(max(v, zero), h_max)
                    iu, iv = np.int32(uc), np.int32(vc)
                    a, b = uc - _f4(iu), vc - _f4(iv)
                    w = quad[np.uint32(np.uint32(iv * width + iu) & _31)]
                    m0, m1 = _f4(np.int32(w & _BYTE)), _f4(np.int32((w >> _8) & _BYTE))
                    m2, m3 = _f4(np.int32((w >> _16) & _BYTE)), _f4(np.int32(w >> _24))
                    top = m0 + a * (m1 - m0)
                    bottom = m2 + a * (m3 - m2)
                    out_of_view = (z < near) | (u != uc) | (v != vc)
                    cost = penalty if out_of_view else (top + b * (bottom - top)) * scale
                    seen = zero if out_of_view else scale
                    du = ((m1 - m0) + b * ((m3 - m2) - (m1 - m0))) * seen * fx
                    dv = (bottom - top) * seen * fy
                    e3 = du * iz
                    e4 = dv * iz
                    e5 = -(e3 * xn + e4 * yn)
                    e0 = y * e5 - z * e4
                    e1 = z * e3 - x * e5
                    e2 = x * e4 - y * e3
                    n = one / (two * max(cost, scale))
                    s += cost
                    g0 += e0
                    g1 += e1
                    g2 += e2
                    g3 += e3
                    g4 += e4
                    g5 += e5
                    n0 = n * e0
                    h00 += n0 * e0
                    h01 += n0 * e1
                    h02 += n0 * e2
                    h03 += n0 * e3
                    h04 += n0 * e4
                    h05 += n0 * e5
                    n1 = n * e1
                    h11 += n1 * e1
                    h12 += n1 * e2
                    h13 += n1 * e3
                    h14 += n1 * e4
                    h15 += n1 * e5
                    n2 = n * e2
                    h22 += n2 * e2
                    h23 += n2 * e3
                    h24 += n2 * e4
                    h25 += n2 * e5
                    n3 = n * e3
                    h33 += n3 * e3
                    h34 += n3 * e4
                    h35 += n3 * e5
                    n4 = n * e4
                    h44 += n4 * e4
                    h45 += n4 * e5
                    n5 = n * e5
                    h55 += n5 * e5
                o = out[p, f]
                o[0] += s
                o[1] += g0
                o[2] += g1
                o[3] += g2
                o[4] += g3
                o[5] += g4
                o[6] += g5
                o[7] += h00
                o[8] += h01
                o[9] += h02
                o[10] += h03
                o[11] += h04
                o[12] += h05
                o[13] += h11
                o[14] += h12
                o[15] += h13
                o[16] += h14
                o[17] += h15
                o[18] += h22
                o[19] += h23
                o[20] += h24
                o[21] += h25
                o[22] += h33
                o[23] += h34
                o[24] += h35
                o[25] += h44
                o[26] += h45
                o[27] += h55


@no_type_check  # keeps the tests' shape checks out of compiled code
@_jit
def polynomial_gradients(poses, xs, ys, zs, first, quads, map_first, size_px, camera, penalty, out) -> None:
    one, two, zero, tiny = _f4(1), _f4(2), _f4(0), _f4(1e-6)
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
        for t0 in range(first[f], first[f + 1], _TILE):
            t1 = min(t0 + _TILE, first[f + 1])
            xt, yt, zt = xs[t0:t1], ys[t0:t1], zs[t0:t1]
            for p in range(len(poses)):
                r0, r1, r2, tx = poses[p, 0], poses[p, 1], poses[p, 2], poses[p, 3]
                r3, r4, r5, ty = poses[p, 4], poses[p, 5], poses[p, 6], poses[p, 7]
                r6, r7, r8, tz = poses[p, 8], poses[p, 9], poses[p, 10], poses[p, 11]
                s = g0 = g1 = g2 = g3 = g4 = g5 = zero
                h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
                h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
                for i in range(len(xt)):
                    x = r0 * xt[i] + r1 * yt[i] + r2 * zt[i] + tx
                    y = r3 * xt[i] + r4 * yt[i] + r5 * zt[i] + ty
                    z = r6 * xt[i] + r7 * yt[i] + r8 * zt[i] + tz
                    inv = one / np.sqrt(x * x + y * y + z * z + tiny)
                    xn, yn, c = x * inv, y * inv, z * inv
                    q = one - max(c, c_min)
                    # Horner's scheme for k and its slope by q together
                    k, dk = k8, zero
                    dk = k + q * dk
                    k = k7 + q * k
                    dk = k + q * dk
                    k = k6 + q * k
                    dk = k + q * dk
                    k = k5 + q * k
                    dk = k + q * dk
                    k = k4 + q * k
                    dk = k + q * dk
                    k = k3 + q * k
                    dk = k + q * dk
                    k = k2 + q * k
                    dk = k + q * dk
                    k = k1 + q * k
                    dk = k + q * dk
                    k = k0 + q * k
                    u, v = xn * k * fx + cx, yn * k * fy + cy
                    uc = min(max(u, zero), w_max)
                    vc = min(max(v, zero), h_max)
                    iu, iv = np.int32(uc), np.int32(vc)
                    a, b = uc - _f4(iu), vc - _f4(iv)
                    w = quad[np.uint32(np.uint32(iv * width + iu) & _31)]
                    m0, m1 = _f4(np.int32(w & _BYTE)), _f4(np.int32((w >> _8) & _BYTE))
                    m2, m3 = _f4(np.int32((w >> _16) & _BYTE)), _f4(np.int32(w >> _24))
                    top = m0 + a * (m1 - m0)
                    bottom = m2 + a * (m3 - m2)
                    out_of_view = (c < c_min) | (u != uc) | (v != vc)
                    cost = penalty if out_of_view else (top + b * (bottom - top)) * scale
                    seen = zero if out_of_view else scale
                    du = ((m1 - m0) + b * ((m3 - m2) - (m1 - m0))) * seen * fx
                    dv = (bottom - top) * seen * fy
                    # u' = fx (k dxn - dk xn dc), with xn = x/|p|: d/dp of a unit vector is (I - n n^T)/|p|
                    along = -dk * (du * xn + dv * yn)
                    dot = k * (du * xn + dv * yn) + along * c
                    e3 = (k * du - dot * xn) * inv
                    e4 = (k * dv - dot * yn) * inv
                    e5 = (along - dot * c) * inv
                    e0 = y * e5 - z * e4
                    e1 = z * e3 - x * e5
                    e2 = x * e4 - y * e3
                    n = one / (two * max(cost, scale))
                    s += cost
                    g0 += e0
                    g1 += e1
                    g2 += e2
                    g3 += e3
                    g4 += e4
                    g5 += e5
                    n0 = n * e0
                    h00 += n0 * e0
                    h01 += n0 * e1
                    h02 += n0 * e2
                    h03 += n0 * e3
                    h04 += n0 * e4
                    h05 += n0 * e5
                    n1 = n * e1
                    h11 += n1 * e1
                    h12 += n1 * e2
                    h13 += n1 * e3
                    h14 += n1 * e4
                    h15 += n1 * e5
                    n2 = n * e2
                    h22 += n2 * e2
                    h23 += n2 * e3
                    h24 += n2 * e4
                    h25 += n2 * e5
                    n3 = n * e3
                    h33 += n3 * e3
                    h34 += n3 * e4
                    h35 += n3 * e5
                    n4 = n * e4
                    h44 += n4 * e4
                    h45 += n4 * e5
                    n5 = n * e5
                    h55 += n5 * e5
                o = out[p, f]
                o[0] += s
                o[1] += g0
                o[2] += g1
                o[3] += g2
                o[4] += g3
                o[5] += g4
                o[6] += g5
                o[7] += h00
                o[8] += h01
                o[9] += h02
                o[10] += h03
                o[11] += h04
                o[12] += h05
                o[13] += h11
                o[14] += h12
                o[15] += h13
                o[16] += h14
                o[17] += h15
                o[18] += h22
                o[19] += h23
                o[20] += h24
                o[21] += h25
                o[22] += h33
                o[23] += h34
                o[24] += h35
                o[25] += h44
                o[26] += h45
                o[27] += h55
