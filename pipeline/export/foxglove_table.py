"""Changes and sigmas of a calibration as one JSON message for a table panel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.export.calibration import ExportedCalibration, ExportedPair, sigmas_of
from pipeline.export.provenance import used_lines, warnings_of
from pipeline.rig.changes import change_between
from schemas.calibrations import DOF_NAMES

__all__ = ["TABLE_SCHEMA", "table_of"]

_IN_UNITS = np.array([np.degrees(1.0)] * 3 + [100.0] * 3)  # rad to deg, m to cm
_ROW = {
    "pair": {"type": "string"},
    "axis": {"type": "string"},
    "change": {"type": "number"},
    "sigma": {"type": "number"},
    "unit": {"type": "string"},
    "determined": {"type": "boolean"},
    "status": {"type": "string"},
}
TABLE_SCHEMA: dict[str, Any] = {
    "type": "object",
    "title": "boresight.Calibration",
    "properties": {
        "vehicle": {"type": "string"},
        "source": {"type": "string"},
        "method": {"type": "string"},
        "warnings": {"type": "array", "items": {"type": "string"}},
        "in_words": {"type": "array", "items": {"type": "string"}},
        "rows": {"type": "array", "items": {"type": "object", "properties": _ROW}},
    },
}


def table_of(
    calibration: ExportedCalibration, priors: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, Any]:
    """A row per pair and axis: change from the prior along the parent's axes, with sigma [deg, cm]."""
    rows = [row for pair in calibration.pairs.values() for row in _rows(pair, priors.get(pair.pair))]
    told = {"vehicle": calibration.vehicle, "source": calibration.source, "method": calibration.method}
    words = {"warnings": warnings_of(calibration), "in_words": used_lines(calibration)}
    return told | words | {"rows": rows}


def _rows(pair: ExportedPair, prior: Float[np.ndarray, "4 4"] | None) -> list[dict[str, Any]]:
    change: list[float | None] = [None] * 6
    if prior is not None:
        change = (change_between(prior, pair.T) * _IN_UNITS).tolist()
    known = sigmas_of(pair.T, pair.covariance)
    sigma: list[float | None] = (
        [None] * 6
        if known is None
        else [float(s * u) for s, u in zip(known.values(), _IN_UNITS, strict=True)]
    )
    units = ["deg"] * 3 + ["cm"] * 3
    rows = [
        {"pair": pair.pair, "axis": axis, "change": c, "sigma": s, "unit": unit, "determined": bool(seen),
         "status": pair.status}
        for axis, c, s, unit, seen in zip(DOF_NAMES, change, sigma, units, pair.observable, strict=True)
    ]  # fmt: skip
    return [{name: value for name, value in row.items() if value is not None} for row in rows]
