"""Rows of any table, filled by what its schema promises."""

from dataclasses import MISSING, fields

import numpy as np

from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, PAIRS, SENSORS, CalibrationRecord
from schemas.captures import CAPTURES
from schemas.drift import DRIFT
from schemas.features import FEATURES
from schemas.frames import Frame
from schemas.moments import MOMENTS, PERCEIVED
from schemas.observations import Observation
from schemas.outcomes import OUTCOMES
from schemas.poses import POSES
from schemas.service_events import SERVICE_EVENTS
from schemas.sign_offs import SIGN_OFFS
from schemas.states import STATES
from schemas.training import TRAINING
from tests.makers.whole_tables import FRAMES, OBSERVATIONS

_MOMENTS = (MOMENTS, PERCEIVED, *CAPTURES.values(), *FEATURES.values(), FRAMES, OBSERVATIONS, TRAINING)
_RECORDS = (CALIBRATIONS, DRIFT, OUTCOMES, POSES, STATES, SERVICE_EVENTS, SIGN_OFFS)
ROW_TYPES = {table.name: (table, table.row_type) for table in (*_MOMENTS, *_RECORDS)}


def make_row(table, rng, *, nulls=False, free=5, **values):
    """A row of `table` whose fields are random values of the right kind, or null where that is allowed."""
    schema, row_type = ROW_TYPES[table]
    if values.get("pair") in FRAMES_OF_PAIR:
        values = (
            dict(zip(("parent_frame", "child_frame"), FRAMES_OF_PAIR[values["pair"]], strict=True)) | values
        )
    filled = {c.name: None if nulls and c.nullable else make_value(c, rng, free) for c in schema.columns}
    return row_type(**filled | values)


def make_record(rng, key, vehicle="car", day="2026-03-02", pair=PAIRS[0], **values):
    """A calibration that is not written yet."""
    values = {"recorded_at": "", "asserted_at": "", "method": "joint"} | values
    return make_row("calibrations", rng, vehicle=vehicle, day=day, pair=pair, work_key=key, **values)


def read_calibrations(lake, **choice):
    """The calibrations of a lake."""
    return read_records(lake, CALIBRATIONS, CalibrationRecord, **choice)


def make_frame(rng, *, nulls=False, free=5, **values):
    """A frame of all three sensors, likewise."""
    return _view(Frame, FRAMES, rng, nulls, free, values)


def make_observation(rng, *, nulls=False, free=5, **values):
    """An observation of all three sensors, likewise."""
    return _view(Observation, OBSERVATIONS, rng, nulls, free, values)


def _view(view, schema, rng, nulls, free, values):
    columns = {c.name: None if nulls and c.nullable else make_value(c, rng, free) for c in schema.columns}
    stamps = {f"{kind}_stamp_ns": columns["stamp_ns"] for kind in SENSORS}
    own = {"log": "a.mcap", "drive": 0, "sensors": list(SENSORS), "priors": {}, **stamps}
    own |= {} if "ego_speed_mps" in columns else {"ego_speed_mps": None, "ego_yaw_rate_radps": None}
    known = columns | own | values
    return view(**{f.name: known[f.name] for f in fields(view) if f.name in known or f.default is MISSING})


def make_value(column, rng, free):
    if column.is_array:
        shape = tuple(free if s == "N" else s for s in column.shape)
        return (rng.normal(size=shape) * 50).astype(column.dtype)
    number = int(rng.integers(0, 1000))
    return {
        "int64": 1_700_000_000_000_000_000 + number, "int32": number, "float64": number / 7,
        "string": f"text {number} äß", "bool": bool(number % 2), "binary": rng.bytes(64),
        "list<string>": ["a", "", f"b{number}"], "list<float64>": [0.5, number / 3], "list<bool>": [True, False],
        "map<string,float64>": {"x": number / 3, "y": 0.0}, "map<string,int64>": {"reason": number},
    }[column.kind]  # fmt: skip


def same(a, b):
    """Two rows are the same, field by field."""
    return all(_equal(value, getattr(b, name)) for name, value in vars(a).items())


def _equal(a, b):
    if not isinstance(a, np.ndarray):
        return a == b
    return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
