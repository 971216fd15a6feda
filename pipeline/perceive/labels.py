"""Semantic classes: from label sets to Cityscapes train ids, from detectors' names to eight road users.

Sources: Cityscapes `labels.py` (train ids); ADE20K `objectInfo150` (ids from 0, as in SegFormer's output);
COCO-Stuff `labels.md` (182 ids, here from 0, 255 = void); COCO detection's 80 consecutive ids.

Image gradients across the borders of the labels show displaced labels without extrinsics. They are summed
along a border with their sign, so that noise cancels. Their size by distance from the label's border is
largest at the image's own border. There is one sum per side of the foreground, because too wide labels move
the maxima of opposite sides apart, while a shift moves them equally. There is also one sum per region of the
image, because a wrong scale moves the two ends of the image apart. Objects and what stands before the sky
are kept apart: segmenters draw them too wide by different amounts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, get_args, no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.core.rigs import RoadUser, StreetClass

__all__ = [
    "BINS", "CITYSCAPES", "DETECTOR_COUNTS", "DETECTOR_SETS", "LABEL_COUNTS", "LABEL_SETS", "REACH_PX",
    "ROAD_ID", "ROAD_USERS", "SKY_ID", "VOID_ID", "label_gradients", "road_user_name", "to_cityscapes",
]  # fmt: skip

CITYSCAPES: tuple[str, ...] = get_args(StreetClass)  # the place is the train id
ROAD_USERS: tuple[str, ...] = get_args(RoadUser)
ROAD_ID, SKY_ID, VOID_ID = 0, 10, 255
# Cityscapes name -> ids of the foreign set, outdoor classes only; every other id is void.
_ADE20K = {
    "road": (6, 54), "sidewalk": (11, 52), "building": (1, 25, 48, 79, 84), "wall": (0,), "fence": (32, 38),
    "pole": (42, 87, 93), "traffic light": (136,), "traffic sign": (43,), "vegetation": (4, 17, 72),
    "terrain": (9, 13, 29, 91, 94), "sky": (2,), "person": (12,), "car": (20, 102), "truck": (83,),
    "bus": (80,), "motorcycle": (116,), "bicycle": (127,),
}  # fmt: skip
_COCO_STUFF = {
    "road": (148,), "sidewalk": (139,), "building": (95, 127, 150, 157),
    "wall": (170, 171, 172, 173, 174, 175, 176), "fence": (112, 137, 145), "traffic light": (9,),
    "traffic sign": (11, 12),
    "vegetation": (93, 96, 118, 128, 133, 141, 168), "terrain": (110, 123, 124, 125, 135, 153),
    "sky": (105, 119, 156), "person": (0,), "car": (2,), "truck": (7,), "bus": (5,), "train": (6,),
    "motorcycle": (3,), "bicycle": (1,),
}  # fmt: skip
LABEL_SETS: dict[str, dict[str, tuple[int, ...]]] = {
    "cityscapes": {name: (train_id,) for train_id, name in enumerate(CITYSCAPES)},
    "ade20k": _ADE20K,
    "coco": _COCO_STUFF,
}
# Classes that a model of a set gives; Cityscapes' also with void as the last.
LABEL_COUNTS: dict[str, tuple[int, ...]] = {"cityscapes": (19, 20), "ade20k": (150,), "coco": (182,)}
# Class index -> road user; other classes are left out.
DETECTOR_SETS: dict[str, dict[int, str]] = {
    "coco": {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 6: "train", 7: "truck"},
    "road_users": dict(enumerate(ROAD_USERS)),
}
# Classes of a head; of another number, each would mean another thing than its set says.
DETECTOR_COUNTS = {"coco": 80, "road_users": len(ROAD_USERS)}
_ALIASES = {
    "pedestrian": "person", "people": "person", "human": "person",
    "cyclist": "rider", "bicyclist": "rider", "motorcyclist": "rider",
    "van": "car", "suv": "car", "pickup": "car", "automobile": "car", "vehicle": "car", "caravan": "car",
    "lorry": "truck", "trailer": "truck", "coach": "bus", "tram": "train",
    "motorbike": "motorcycle", "motor": "motorcycle", "scooter": "motorcycle", "bike": "bicycle",
}  # fmt: skip
# Gradients are kept from -16 to +16 label pixels: 2 % of 912 pixels shift the image's ends by 9.
REACH_PX: Final = 16
BINS: Final = 6  # equal parts of the image's width (left, right) or height (above, below)
_RUN_PX = 16  # of border over which gradients are summed with their sign: on nights twice the contrast of 1
_FLOOR_GREY = 5.0  # gradients of a border without contrast count less than those of one with this much
_SKY, _BACKDROP, _OBJECT, _GROUND = (10,), (2, 3, 4, 8), (5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18), (0, 1, 9)


def _foregrounds(*groups: tuple[tuple[int, ...], tuple[int, ...]]) -> UInt8[np.ndarray, "256 256"]:
    """Nearer side of a border between labels a (left or above) and b: odd = a, even = b, 0 = not used.

    Counted on by two from the first group of (far, near) labels to the next.
    """
    nearer = np.zeros((256, 256), np.uint8)
    for number, (far, near) in enumerate(groups):
        nearer[np.ix_(near, far)] = 2 * number + 1
        nearer[np.ix_(far, near)] = 2 * number + 2
    return nearer


# Borders of two labels of a group, and of the ground before walls and plants, are not used. Kerbs and shadows are next
# to the latter: on eight simulated days and the real car they moved the vertical offset by .1 to .6 px.
_FOREGROUND = _foregrounds(((*_SKY, *_BACKDROP, *_GROUND), _OBJECT), (_SKY, _BACKDROP))


def to_cityscapes(label_set: str | Mapping[StreetClass, tuple[int, ...]]) -> UInt8[np.ndarray, " 256"]:
    """Lookup table from labels of a set (name or meanings) to Cityscapes train ids; others are VOID_ID."""
    table = np.full(256, VOID_ID, np.uint8)
    meaning: Mapping[str, tuple[int, ...]] = (
        LABEL_SETS[label_set] if isinstance(label_set, str) else {str(k): v for k, v in label_set.items()}
    )
    for name, foreign in meaning.items():
        table[list(foreign)] = CITYSCAPES.index(name)
    return table


def road_user_name(logged: str) -> str | None:
    """Road user of a logged class name; None for other classes (traffic light, dog)."""
    name = logged.strip().lower().replace("_", " ")
    return name if name in ROAD_USERS else _ALIASES.get(name)


def label_gradients(
    grey: UInt8[np.ndarray, "H W"], labels: UInt8[np.ndarray, "H W"]
) -> Float32[np.ndarray, "8 6 33"]:
    """Sums of normalised gradients across borders, by side, place and distance from the border.

    Returns:
        By EDGE_* side of objects, then of what stands before the sky. Element d is the gradient between the
        pixels d - REACH_PX before and one pixel further, counted from the border to the right (left, right) or
        down (above, below). Each run of border counts by its length.
    """
    across, down = np.zeros((2, 4, BINS, 2 * REACH_PX + 1), np.float32)
    _add_runs(_FOREGROUND, labels, grey, _borders(labels), across)
    labels, grey = cv2.transpose(labels), cv2.transpose(grey)
    _add_runs(_FOREGROUND, labels, grey, _borders(labels), down)
    return np.concatenate([across[:2], down[:2], across[2:], down[2:]])


def _borders(labels: np.ndarray) -> np.ndarray:
    """Flat indices of pixels whose right neighbour has another label; NumPy compares 64 at once."""
    differs = np.zeros(labels.shape, bool)
    np.not_equal(
        labels[:, REACH_PX : -REACH_PX - 1], labels[:, REACH_PX + 1 : -REACH_PX],
        out=differs[:, REACH_PX : -REACH_PX - 1],
    )  # fmt: skip
    return np.flatnonzero(differs)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _add_runs(
    foreground: np.ndarray, labels: np.ndarray, grey: np.ndarray, borders: np.ndarray, out: np.ndarray
) -> None:
    """Add the runs of borders between columns, followed down the rows."""
    height, width = labels.shape
    done = np.zeros((height, width), np.bool_)
    total = np.zeros(out.shape[2], np.int32)
    for place in borders:
        i, j = place // width, place % width
        a, b = labels[i, j], labels[i, j + 1]
        if done[i, j] or foreground[a, b] == 0:
            continue
        length = _sum_run(labels, grey, done, i, j, total)
        size = np.float32(length * _FLOOR_GREY)
        for d in range(total.shape[0]):
            size += abs(total[d])
        mine = out[foreground[a, b] - 1, j * out.shape[1] // width]
        for d in range(total.shape[0]):
            mine[d] += length * abs(total[d]) / size


@no_type_check
@numba.njit(cache=True, nogil=True, inline="always")
def _sum_run(
    labels: np.ndarray, grey: np.ndarray, done: np.ndarray, i: int, j: int, total: np.ndarray
) -> int:
    """Length of the run from (i, j) on; its signed gradients into `total`."""
    height, width = labels.shape
    reach, a, b, length = total.shape[0] // 2, labels[i, j], labels[i, j + 1], 0
    total[:] = 0
    while j >= 0:
        done[i, j] = True
        length += 1
        for d in range(total.shape[0]):
            at = j - reach + d
            total[d] += np.int32(grey[i, at + 1]) - np.int32(grey[i, at])
        i += 1
        if length == _RUN_PX or i == height:
            break
        follows = -1
        for step in (0, -1, 1, -2, 2):
            k = j + step
            inside = k >= reach and k < width - 1 - reach
            if inside and labels[i, k] == a and labels[i, k + 1] == b and not done[i, k]:
                follows = k
                break
        j = follows
    return length
