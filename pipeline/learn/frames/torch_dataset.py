"""Frames of a Parquet export in torch. The export holds a copy of this file, which needs torch and pyarrow alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch

__all__ = ["Frames"]


class Frames(torch.utils.data.Dataset[dict[str, Any]]):
    """Frames of a split as dicts; `DataLoader(Frames(folder, "train"), num_workers=2, collate_fn=list)`."""

    def __init__(self, folder: str, split: str = "train") -> None:
        names = json.loads(Path(folder, "card.json").read_text())["files"].get(split, [])
        files = [str(Path(folder, name)) for name in names]
        self.rows = [(file, row) for file in files for row in range(pq.read_metadata(file).num_row_groups)]

    def __len__(self) -> int:
        """Frames of the split."""
        return len(self.rows)

    def __getitem__(self, i: int) -> dict[str, Any]:
        """A frame (see README.md): per sensor `points` [N x fields], or coded `image` and `labels_png`."""
        file, group = self.rows[i]
        [row] = pq.ParquetFile(file).read_row_group(group).to_pylist()
        frame: dict[str, Any] = json.loads(row["about"])
        for found in row["sensors"]:
            own = frame["sensors"][found["name"]]
            if found["points"] is not None:
                points = np.frombuffer(found["points"], "<f4").reshape(-1, len(found["fields"]))
                own["points"] = torch.from_numpy(points.copy())
            for name in ("image", "labels_png"):
                if found[name] is not None:
                    own[name] = torch.frombuffer(bytearray(found[name]), dtype=torch.uint8)
        return frame
