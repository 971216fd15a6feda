"""Tables of a nuScenes folder from the rows of its vehicle-days, and its splits by scene.

Source: nuscenes-devkit, docs/schema_nuscenes.md, utils/splits.py (custom splits.json).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import ExitStack

import cv2
import numpy as np

from pipeline.learn.frames.facts import to_json
from pipeline.learn.frames.output import Output
from pipeline.store.partitions import Partition
from schemas.training import SPLITS

__all__ = ["VERSION", "finish_nuscenes", "token_of"]

VERSION = "v1.0-boresight"
# Tables that the devkit opens; the last three are of others.
_TABLES = (
    *(
        "category",
        "attribute",
        "visibility",
        "instance",
        "sensor",
        "calibrated_sensor",
        "ego_pose",
        "log",
        "scene",
    ),
    *("sample", "sample_data", "sample_annotation", "map", "object_ann", "calibrated_sensor_answer"),
)
_SHARED = {"sensor", "category"}


def finish_nuscenes(output: Output, days: Sequence[Partition]) -> None:
    """Write all tables, and the splits by scene; one row is in memory at a time."""
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    logs: list[str] = []
    known: set[str] = set()  # of tables whose rows several days share
    with ExitStack() as stack:
        streams = {
            table: stack.enter_context(output.replacing(f"{VERSION}/{table}.json")) for table in _TABLES
        }
        began = set[str]()
        for day in days:
            for table, row in output.rows(day):
                if table in splits:
                    splits[table].append(row)
                if table not in streams or row["token"] in known:
                    continue
                known |= {row["token"]} if table in _SHARED else set()
                logs += [row["token"]] if table == "log" else []
                streams[table].write((b",\n" if table in began else b"[\n") + to_json(row))
                began.add(table)
        streams["map"].write(b"[\n" + to_json({
            "token": token_of("map"), "log_tokens": logs, "category": "none", "filename": "maps/none.png",
        }))  # fmt: skip
        for table, stream in streams.items():
            stream.write(b"\n]\n" if table in began | {"map"} else b"[]\n")
    output.write("maps/none.png", cv2.imencode(".png", np.full((1, 1), 128, np.uint8))[1].tobytes())
    output.write(f"{VERSION}/splits.json", to_json(splits))


def token_of(*words: str) -> str:
    """32 hexadecimal digits that are the same for the same words."""
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:32]
