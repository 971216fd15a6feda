"""Semantic classes: every label set is brought to Cityscapes train ids, every detector's names to eight road users.

Sources: Cityscapes `labels.py` (train ids); ADE20K `objectInfo150` (ids from 0, as SegFormer puts them out); COCO-Stuff
`labels.md` (182 ids, here from 0, 255 = void); COCO detection's 80 consecutive ids.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8

__all__ = [
    "CITYSCAPES",
    "DETECTOR_SETS",
    "LABEL_SETS",
    "REFLECTING_IDS",
    "ROAD_ID",
    "ROAD_USERS",
    "SKY_ID",
    "VOID_ID",
    "detector_names",
    "is_reflecting",
    "road_user_name",
    "to_cityscapes",
]

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
ROAD_USERS = ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
ROAD_ID, SKY_ID, VOID_ID = 0, 10, 255
# Paper, section 4.3: vehicles, pedestrians, signs, poles, buildings, fences and vegetation reflect lidar.
REFLECTING_IDS = (2, 3, 4, 5, 6, 7, 8, 11, 12, 13, 14, 15, 16, 17, 18)

# Foreign id -> Cityscapes name, outdoor classes only; everything else is void.
_ADE20K = {
    0: "wall", 1: "building", 2: "sky", 4: "vegetation", 6: "road", 9: "terrain", 11: "sidewalk", 12: "person",
    13: "terrain", 17: "vegetation", 20: "car", 25: "building", 29: "terrain", 32: "fence", 38: "fence", 42: "pole",
    43: "traffic sign", 48: "building", 52: "sidewalk", 54: "road", 72: "vegetation", 79: "building", 80: "bus",
    83: "truck", 84: "building", 87: "pole", 91: "terrain", 93: "pole", 94: "terrain", 102: "car", 116: "motorcycle",
    127: "bicycle", 136: "traffic light",
}  # fmt: skip
_COCO_STUFF = {
    0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 6: "train", 7: "truck", 9: "traffic light",
    11: "traffic sign", 12: "traffic sign", 93: "vegetation", 95: "building", 96: "vegetation", 105: "sky", 110: "terrain",
    112: "fence", 118: "vegetation", 119: "sky", 123: "terrain", 124: "terrain", 125: "terrain", 127: "building",
    128: "vegetation", 133: "vegetation", 135: "terrain", 137: "fence", 139: "sidewalk", 141: "vegetation", 145: "fence",
    148: "road", 150: "building", 153: "terrain", 156: "sky", 157: "building", 168: "vegetation", 170: "wall", 171: "wall",
    172: "wall", 173: "wall", 174: "wall", 175: "wall", 176: "wall",
}  # fmt: skip
LABEL_SETS: dict[str, dict[int, str]] = {
    "cityscapes": dict(enumerate(CITYSCAPES)),
    "ade20k": _ADE20K,
    "coco": _COCO_STUFF,
}

DETECTOR_SETS: dict[str, dict[int, str]] = {
    "coco": {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 6: "train", 7: "truck"},
    "road_users": dict(enumerate(ROAD_USERS)),
}
_ALIASES = {
    "pedestrian": "person", "people": "person", "human": "person",
    "cyclist": "rider", "bicyclist": "rider", "motorcyclist": "rider",
    "van": "car", "suv": "car", "pickup": "car", "automobile": "car", "vehicle": "car", "caravan": "car",
    "lorry": "truck", "trailer": "truck", "coach": "bus", "tram": "train",
    "motorbike": "motorcycle", "motor": "motorcycle", "scooter": "motorcycle", "bike": "bicycle",
}  # fmt: skip


def to_cityscapes(label_set: str) -> UInt8[np.ndarray, "256"]:
    """Lookup table from labels of a set to Cityscapes train ids; what has no counterpart becomes VOID_ID."""
    table = np.full(256, VOID_ID, np.uint8)
    for foreign, name in LABEL_SETS[label_set].items():
        table[foreign] = CITYSCAPES.index(name)
    return table


def detector_names(label_set: str) -> dict[int, str]:
    """Class index -> road user of a detector's label set; other classes are left out."""
    return DETECTOR_SETS[label_set]


def road_user_name(logged: str) -> str | None:
    """The road user that a logged class name means, None where it means none (traffic light, dog)."""
    name = logged.strip().lower().replace("_", " ")
    return name if name in ROAD_USERS else _ALIASES.get(name)


def is_reflecting(labels: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """True where the label's class is known to reflect lidar (paper, section 4.3)."""
    table = np.zeros(256, bool)
    table[list(REFLECTING_IDS)] = True
    return table[labels]
