"""The road surface: asphalt, repairs, manholes, paint."""

from __future__ import annotations

import numpy as np

from pipeline.simulate.world.chunk import Chunk
from pipeline.simulate.world.props import signal

__all__ = ["add_asphalt"]


def add_asphalt(c: Chunk) -> None:
    """Asphalt with repairs and manholes, lane markings, crossings with their signals."""
    layout, lift = c.drive.layout, 0.004
    c.strip((layout.right_edge, layout.left_edge), (0.0, 0.0), c.drive.landscape.surface)
    for _ in range(int(c.rng.integers(0, 4))):  # repairs: dark in the image, less so for the lidar
        s, d = (
            c.s0 + c.rng.uniform(2, 30),
            c.rng.uniform(layout.right_edge + 1, max(layout.left_edge, 3.0) - 3),
        )
        c.band(
            (s, s + c.rng.uniform(1.5, 9)),
            (d, d + c.rng.uniform(0.6, 2.4)),
            (lift / 2, lift / 2),
            "asphalt_patch",
        )
    for _ in range(int(c.rng.integers(0, 3))):
        s, d = c.s0 + c.rng.uniform(0, 39), c.rng.uniform(layout.right_edge + 1, layout.left_edge - 1)
        c.band((s, s + 0.62), (d, d + 0.62), (lift, lift), "manhole")
    if c.drive.landscape.markings:
        _lanes(c)


def _lanes(c: Chunk) -> None:
    layout, lift = c.drive.layout, 0.004
    own, other = sorted(layout.lanes_own), sorted(layout.lanes_oncoming)
    half = layout.lane_m / 2
    inner = [d + half for d in own[:-1]] + [d + half for d in other[:-1]]
    for d in inner:
        _dashes(c, d, 6.0, 12.0) if layout.landscape.fast else _dashes(c, d, 3.0, 9.0)
    w = 0.10 if layout.landscape.fast else 0.075
    if layout.landscape.fast:
        for d in (own[-1] + half, own[0] - half, other[0] - half, other[-1] + half):
            c.strip((d - 1.5 * w, d + 1.5 * w), (lift, lift), "paint")
        return
    if c.index % 5 in (1, 2):
        c.strip((-w, w), (lift, lift), "paint")
    else:
        _dashes(c, 0.0, 3.0, 9.0)
    for side in (-1, 1):
        edge = side * (layout.left_edge - layout.parking_m)
        if layout.parking_m:
            c.strip((edge - w, edge + w), (lift, lift), "paint")
            for s in c.every(6.5):
                c.band(
                    (s - w, s + w),
                    (min(edge, side * layout.left_edge), max(edge, side * layout.left_edge)),
                    (lift, lift),
                    "paint",
                )
    if c.index % 4 == 1 and layout.lanes_oncoming and not c.drive.landscape.ceiling_m:
        _crossing(c, c.s0 + 20.0)


def _dashes(c: Chunk, d: float, dash_m: float, period_m: float) -> None:
    for s in c.every(period_m):
        c.band((s, s + dash_m), (d - 0.075, d + 0.075), (0.004, 0.004), "paint", step=3.0)


def _crossing(c: Chunk, s: float) -> None:
    layout = c.drive.layout
    edge = layout.left_edge
    for d in np.arange(-edge + 0.5, edge - 0.5, 1.0):
        c.band((s, s + 3.5), (float(d), float(d) + 0.5), (0.005, 0.005), "paint")
    c.band((s - 1.6, s - 1.2), (-edge + layout.parking_m, 0.0), (0.005, 0.005), "paint")
    c.band((s + 4.8, s + 5.2), (0.0, edge - layout.parking_m), (0.005, 0.005), "paint")
    for d in layout.lanes_own:
        _arrow(c, s - 12.0, d)
    for side, yaw in ((-1, np.pi), (1, 0.0)):
        c.put(signal(), s - 1.0 if side < 0 else s + 4.5, side * (edge + 0.5), 0.12, yaw)


def _arrow(c: Chunk, s: float, d: float) -> None:
    c.band((s, s + 2.4), (d - 0.08, d + 0.08), (0.005, 0.005), "paint")
    head = np.array(
        [[[s + 2.4, d - 0.35, 0.005], [s + 4.0, d, 0.005], [s + 4.0, d, 0.005], [s + 2.4, d + 0.35, 0.005]]]
    )
    c.along.quads(head, "paint", uv=head[..., :2])
