"""Semantic classes: from label sets to Cityscapes train ids, from detectors' names to eight road users.

Sources: Cityscapes `labels.py` (train ids); ADE20K `objectInfo150` (ids from 0, as in SegFormer's output);
COCO-Stuff `labels.md` (182 ids, here from 0, 255 = void); COCO detection's 80 consecutive ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import numpy as np
from jaxtyping import UInt8

from pipeline.core.rigs import RoadUser, StreetClass

__all__ = [
    "CITYSCAPES",
    "DETECTOR_COUNTS",
    "DETECTOR_SETS",
    "LABEL_COUNTS",
    "LABEL_SETS",
    "ROAD_ID",
    "ROAD_USERS",
    "SKY_ID",
    "VOID_ID",
    "detector_names",
    "road_user_name",
    "to_cityscapes",
]

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


def to_cityscapes(label_set: str | Mapping[StreetClass, tuple[int, ...]]) -> UInt8[np.ndarray, " 256"]:
    """Lookup table from labels of a set (name or meanings) to Cityscapes train ids; others are VOID_ID."""
    table = np.full(256, VOID_ID, np.uint8)
    meaning: Mapping[str, tuple[int, ...]] = (
        LABEL_SETS[label_set] if isinstance(label_set, str) else {str(k): v for k, v in label_set.items()}
    )
    for name, foreign in meaning.items():
        table[list(foreign)] = CITYSCAPES.index(name)
    return table


def detector_names(label_set: str) -> dict[int, str]:
    """Class index -> road user of a detector's label set; other classes are left out."""
    return DETECTOR_SETS[label_set]


def road_user_name(logged: str) -> str | None:
    """Road user of a logged class name; None for other classes (traffic light, dog)."""
    name = logged.strip().lower().replace("_", " ")
    return name if name in ROAD_USERS else _ALIASES.get(name)
