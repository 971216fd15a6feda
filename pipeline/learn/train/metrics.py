"""Reports of a run: metrics.jsonl, one line per report, and TensorBoard events in the same folder."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, TextIO

__all__ = ["MetricsLog", "read_metrics"]


class MetricsLog:
    """Appends reports of a run; after a resume, lines beyond the checkpoint are dropped first, so none is doubled.

    Args:
        from_step: reports of later steps are dropped.
        events: whether to write TensorBoard events as well, where TensorBoard is installed.
    """

    def __init__(self, folder: Path, from_step: int, *, events: bool = True) -> None:
        self._path = folder / "metrics.jsonl"
        kept = [r for r in read_metrics(folder) if r["step"] <= from_step]
        self._path.write_text("".join(json.dumps(r) + "\n" for r in kept))
        self._file: TextIO = self._path.open("a")
        self._events = _writer(folder / "events", from_step) if events else None

    def report(self, step: int, values: dict[str, float]) -> None:
        """One report; values that are not finite become null."""
        plain = {k: v if math.isfinite(v) else None for k, v in values.items()}
        self._file.write(json.dumps({"step": step} | plain) + "\n")
        self._file.flush()
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Finish both files; `contextlib.closing` calls it."""
        self._file.close()
        if self._events is not None:
            self._events.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All complete lines of a run's reports, oldest first."""
    path = folder / "metrics.jsonl"
    if not path.exists():
        return []
    lines = path.read_text().split("\n")
    return [json.loads(line) for line in lines[:-1]]  # a killed run may leave its last line unfinished


def _writer(folder: Path, from_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - needs the extra [train]
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=from_step + 1)
