"""Outputs of perception networks in the car: a label map and road-user boxes, with typical errors.

Labels: boundaries wander and grow by about a pixel, thin objects break, whole regions have a confused class.
Boxes: small and hidden road users are missed, edges jitter with the size, some boxes are false.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float, Int32, UInt8

from pipeline.simulate.world.casting import Moment
from pipeline.simulate.world.materials import LABELS, TABLE

__all__ = ["Box", "SemanticsSpec", "boxes_of", "encode_png", "label_image", "noisy_boxes", "noisy_labels"]

_SKY: Final = LABELS.index("sky")
_THINGS: Final = tuple(
    LABELS.index(n)
    for n in ("pole", "traffic light", "traffic sign", "person", "rider", "car", "truck", "bus", "bicycle")
)
_COCO: Final = {n: n for n in ("person", "car", "truck", "bus", "bicycle")} | {"rider": "person"}
# By class: the one that it is confused with, from published confusion matrices of Cityscapes networks, and how
# often (1 = the mean): roads rarely, walls and fences often.
_CONFUSED: Final = {
    "road": ("sidewalk", 0.12),
    "sidewalk": ("road", 1.6),
    "building": ("wall", 0.9),
    "wall": ("building", 6.0),
    "fence": ("vegetation", 5.0),
    "pole": ("building", 2.5),
    "traffic light": ("building", 1.0),
    "traffic sign": ("building", 2.0),
    "vegetation": ("terrain", 0.8),
    "terrain": ("vegetation", 2.5),
    "person": ("rider", 1.0),
    "rider": ("person", 3.0),
    "car": ("truck", 0.6),
    "truck": ("car", 4.0),
    "bus": ("truck", 3.0),
    "bicycle": ("vegetation", 2.5),
    "sky": ("building", 0.01),
}


@dataclass(frozen=True)
class SemanticsSpec:
    """Error rates of the networks."""

    boundary_px: float = 0.9  # sd of the wandering, half-size pixels
    swell: float = 0.45  # share of boundary where objects grow by a pixel
    confusion: float = 0.05  # share of the area outside the sky with a wrong class
    miss: float = 0.04  # for road users that are large and unoccluded
    box_jitter: float = 0.022  # of the box's size, per edge
    false_boxes: float = 0.12  # per image


@dataclass(frozen=True)
class Box:
    """One road user in the image, full-size pixels."""

    x0: float
    y0: float
    x1: float
    y1: float
    name: str
    score: float


def label_image(moment: Moment, coarse: Int32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """True labels of a half-size view."""
    of_triangle = np.append(TABLE.label[moment.mesh.material], np.uint8(_SKY))  # row -1 is the sky
    return of_triangle[coarse]


def _field(shape: tuple[int, int], cell_px: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth random field, zero mean, about unit variance."""
    h, w = shape
    small = rng.standard_normal((int(h / cell_px) + 3, int(w / cell_px) + 3), dtype=np.float32)
    return cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC) * np.float32(1.35)


def noisy_labels(
    true: UInt8[np.ndarray, "h w"], spec: SemanticsSpec, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w"]:
    """Labels as a network would output them."""
    h, w = true.shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    # Mostly slow variation of whole outlines, with some noise.
    at = [
        (axis + spec.boundary_px * (0.85 * _field((h, w), 14.0, rng) + 0.45 * _field((h, w), 4.0, rng)))
        for axis in (x, y)
    ]
    out = cv2.remap(true, *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    things = np.where(np.isin(out, _THINGS), out, np.uint8(0))
    grown = cv2.dilate(things, np.ones((3, 3), np.uint8))
    swell = (
        (grown > 0) & (things == 0) & (_field((h, w), 12.0, rng) > float(np.sqrt(2)) * _quantile(spec.swell))
    )
    out = cv2.medianBlur(np.where(swell, grown, out), 3)  # removes parts thinner than two pixels
    return _confused(out, spec.confusion, rng)


def _quantile(share: float) -> float:
    """Threshold, in sqrt 2 sigma, exceeded by a share of a normal field (inverse error function)."""
    u = np.clip(1 - 2 * share, -0.999, 0.999)
    log = np.log(1 - u * u)
    inner = 2 / (np.pi * 0.147) + log / 2  # Winitzki 2008
    return float(np.sign(u) * np.sqrt(np.sqrt(inner * inner - log / 0.147) - inner))


def _confused(labels: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Change the class of patches of a few dozen pixels to one it is confused with."""
    table, proneness = np.arange(256, dtype=np.uint8), np.ones(256)
    for name, (other, factor) in _CONFUSED.items():
        table[LABELS.index(name)], proneness[LABELS.index(name)] = LABELS.index(other), factor
    threshold = np.array([np.sqrt(2) * _quantile(min(share * p, 0.45)) for p in proneness], np.float32)
    w = labels.shape[1]
    field = 0.9 * _field(labels.shape, w / 13, rng) + 0.42 * _field(labels.shape, w / 50, rng)
    return np.where(field > threshold[labels], table[labels], labels)


def boxes_of(moment: Moment, coarse: Int32[np.ndarray, "h w"]) -> list[tuple[Box, int]]:
    """Tight boxes of the visible parts of road users, with their number of visible half-size pixels."""
    mesh = moment.mesh
    bodies = np.flatnonzero(mesh.instance > 0)
    who = mesh.instance[bodies].astype(np.int64) * 32 + TABLE.label[mesh.material[bodies]]
    keys, number = np.unique(who, return_inverse=True)
    group = np.full(len(mesh), -1, np.int64)
    group[bodies] = number
    found = []
    for key, (*corners, pixels) in zip(keys, _extents(coarse, group, len(keys)).tolist(), strict=True):
        if pixels > 0 and LABELS[key % 32] in _COCO:
            # half-size pixel j covers full-size pixels 2j and 2j + 1
            x0, y0, x1, y1 = (2.0 * np.array(corners) + [-0.5, -0.5, 1.5, 1.5]).tolist()
            found.append((Box(x0, y0, x1, y1, _COCO[LABELS[key % 32]], 1.0), pixels))
    return found


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True)
def _extents(coarse, group, groups):  # noqa: ANN001, ANN202 - compiled
    """(x0, y0, x1, y1, pixels) of each group of triangles."""
    out = np.empty((groups, 5), np.int64)
    out[:, :2], out[:, 2:] = 1 << 30, -1
    out[:, 4] = 0
    h, w = coarse.shape
    for i in range(h):
        for j in range(w):
            k = coarse[i, j]
            if k >= 0 and group[k] >= 0:
                o = out[group[k]]
                o[0], o[1], o[2], o[3] = min(o[0], j), min(o[1], i), max(o[2], j), max(o[3], i)
                o[4] += 1
    return out


def noisy_boxes(
    true: list[tuple[Box, int]], size_px: tuple[int, int], spec: SemanticsSpec, rng: np.random.Generator
) -> list[Box]:
    """Boxes as a detector would output them; size_px = (width, height)."""
    width, height = size_px
    out = []
    for box, pixels in true:
        w, h = box.x1 - box.x0, box.y1 - box.y0
        filled = 4.0 * pixels / max(w * h, 1.0)  # low if occluded
        visible = np.clip((h / height - 0.012) / 0.025, 0, 1) * np.clip((filled - 0.18) / 0.25, 0, 1)
        if rng.random() > (1 - spec.miss) * visible:
            continue
        jitter = spec.box_jitter * np.array([w, h, w, h]) * rng.standard_normal(4)
        edges = np.array([box.x0, box.y0, box.x1, box.y1]) + (jitter + 0.5 * rng.standard_normal(4))
        name = "truck" if box.name == "car" and rng.random() < 0.03 else box.name
        score = np.clip(0.35 + 0.6 * visible + 0.08 * rng.standard_normal(), 0.25, 0.99)
        out.append(_clipped(edges, size_px, name, float(score)))
    for _ in range(rng.poisson(spec.false_boxes)):
        x, y, h = rng.uniform(0, width), height * rng.uniform(0.45, 0.7), height * rng.uniform(0.04, 0.15)
        edges = np.array([x, y, x + h * rng.uniform(0.5, 1.8), y + h])
        name = ("car", "person")[int(rng.integers(2))]
        out.append(_clipped(edges, size_px, name, rng.uniform(0.25, 0.6)))
    return out


def _clipped(edges: Float[np.ndarray, " 4"], size_px: tuple[int, int], name: str, score: float) -> Box:
    x0, y0, x1, y1 = np.clip(edges, -0.5, np.tile(size_px, 2) - 0.5).tolist()
    return Box(x0, y0, x1, y1, name, score)


def encode_png(labels: UInt8[np.ndarray, "h w"]) -> bytes:
    """PNG mono8."""
    return cv2.imencode(".png", labels, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()
