"""Description of a table by the dataclass of its rows, and the Arrow and JSON Schemas derived from it.

The fields of a row are the columns of the table (`column`, `array`); `TableSchema` collects them.

Arrays are stored as `binary` blobs, little-endian and C-ordered, because Parquet reads them 4-10x faster than
list columns. The metadata of the column's Arrow field has dtype and shape, so any engine can decode them:
`numpy.frombuffer(blob, dtype).reshape(shape)`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import Field, dataclass, field, fields
from types import UnionType
from typing import Any, TypeVar, dataclass_transform, get_args, get_type_hints

import numpy as np
import pyarrow as pa

from schemas.words import RECORD_WORDS, listed

__all__ = [
    "FAULTS_DOC", "OBSERVABILITY_DOC", "POSE_COLUMNS", "STATUS_DOC", "Column", "Posed", "Recorded",
    "TableSchema", "array", "column", "per_point", "points", "row",
]  # fmt: skip

# Columns of a pose T_a_b; where a row has several, each has a prefix (prior_qw, ego_tx_m).
POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")

# Descriptions of columns that several tables have.
OBSERVABILITY_DOC = "per DoF: 1 - posterior/prior variance along it; 0 = the day adds no information"
STATUS_DOC = listed(RECORD_WORDS)
FAULTS_DOC = "faults named in the reason, keys of FAULTS in schemas/faults.py"

Row = TypeVar("Row")

# Kind -> its type in Arrow, and in JSON Schema.
_TYPES: dict[str, tuple[pa.DataType, dict[str, Any]]] = {
    "int64": (pa.int64(), {"type": "integer"}),
    "int32": (pa.int32(), {"type": "integer"}),
    "float64": (pa.float64(), {"type": "number"}),
    "string": (pa.string(), {"type": "string"}),
    "bool": (pa.bool_(), {"type": "boolean"}),
    "binary": (pa.binary(), {"type": "string", "contentEncoding": "base64"}),
    "list<string>": (pa.list_(pa.string()), {"type": "array", "items": {"type": "string"}}),
    "list<float64>": (pa.list_(pa.float64()), {"type": "array", "items": {"type": "number"}}),
    "list<bool>": (pa.list_(pa.bool_()), {"type": "array", "items": {"type": "boolean"}}),
    "map<string,float64>": (
        pa.map_(pa.string(), pa.float64()),
        {"type": "object", "additionalProperties": {"type": "number"}},
    ),
    "map<string,int64>": (
        pa.map_(pa.string(), pa.int64()),
        {"type": "object", "additionalProperties": {"type": "integer"}},
    ),
}
_KINDS: dict[Any, str] = {
    int: "int64",
    float: "float64",
    str: "string",
    bool: "bool",
    bytes: "binary",
    list[str]: "list<string>",
    list[float]: "list<float64>",
    list[bool]: "list<bool>",
    dict[str, float]: "map<string,float64>",
    dict[str, int]: "map<string,int64>",
}


@dataclass(frozen=True)
class Column:
    """One column. The name includes the unit; `shape` is set for arrays, with "N" for the free axis."""

    name: str
    kind: str  # key of _TYPES
    doc: str
    nullable: bool = False
    dtype: str | None = None
    shape: tuple[str | int, ...] = ()

    @property
    def is_array(self) -> bool:
        """True for a blob that decodes to an array."""
        return self.dtype is not None

    def arrow_field(self) -> pa.Field:
        """The Arrow field, with dtype and shape in its metadata if the column is an array."""
        metadata = {"doc": self.doc}
        if self.dtype is not None:
            metadata |= {"dtype": self.dtype, "shape": ",".join(map(str, self.shape))}
        return pa.field(self.name, _TYPES[self.kind][0], nullable=self.nullable, metadata=metadata)

    def json_schema(self) -> dict[str, Any]:
        """The JSON Schema of one value of this column."""
        value = _TYPES[self.kind][1] | {"description": self.doc}
        if self.dtype is not None:
            value |= {"x-dtype": self.dtype, "x-shape": list(self.shape)}
        return {"anyOf": [value, {"type": "null"}]} if self.nullable else value


@dataclass(frozen=True)
class TableSchema:
    """A table: one column per field of its rows. Every change visible to readers increments the version."""

    row_type: type = field(compare=False, repr=False)
    name: str
    version: int
    doc: str = ""
    made_by: str = ""  # stage and command that write it
    # For record tables: columns that identify the subject of a row. Among rows with the same subject, the one
    # asserted last is current; work_key distinguishes them. Empty for tables of partitions that are replaced
    # as a whole.
    about: tuple[str, ...] = ()
    of_sensor: bool = False  # a partition has a file per sensor, joined by another table
    # The fields of the row type in their order, inherited ones last.
    columns: tuple[Column, ...] = field(init=False)

    def __post_init__(self) -> None:
        bases = reversed([*enumerate(self.row_type.__mro__)])
        of_base = {name: k for k, base in bases for name in vars(base).get("__annotations__", ())}
        types = get_type_hints(self.row_type)
        ordered = sorted(fields(self.row_type), key=lambda f: of_base[f.name])
        object.__setattr__(self, "columns", tuple(_column(f, types[f.name]) for f in ordered))

    @property
    def is_record_table(self) -> bool:
        """True for a table whose rows are added; False for a table whose partitions are replaced."""
        return bool(self.about)

    def about_of(self, row: Any) -> tuple[str, ...]:
        """Subject of a record: its values of the columns `about`."""
        return tuple(getattr(row, name) for name in self.about)

    def rows_among(self, rows: Iterable[Any]) -> list[Any]:
        """The rows of this table among rows of several tables."""
        return [row for row in rows if type(row) is self.row_type]

    def arrow_schema(self) -> pa.Schema:
        """Arrow schema of every file of the table."""
        return pa.schema([c.arrow_field() for c in self.columns])

    def column(self, name: str) -> Column:
        """The column with this name; raises KeyError if the table has none."""
        found = {column.name: column for column in self.columns}
        if name not in found:
            raise KeyError(f"table {self.name} has no column {name}")
        return found[name]

    def json_schema(self) -> dict[str, Any]:
        """JSON Schema (2020-12) of one row."""
        return {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"{self.name}/{self.version}",
            "description": self.doc,
            "type": "object",
            "properties": {c.name: c.json_schema() for c in self.columns},
            "required": [c.name for c in self.columns],
            "additionalProperties": False,
        }


def column(doc: str, *, kind: str = "", **default: Any) -> Any:
    """A dataclass field for a scalar column; `kind` is its type if the annotation leaves it open (int32)."""
    return field(**default, metadata={"doc": doc, "kind": kind})


def array(dtype: str, shape: tuple[str | int, ...], doc: str, **default: Any) -> Any:
    """A dataclass field for a blob: little-endian `dtype` (as "<f4"), `shape` with "N" for the free axis."""
    return field(**default, metadata={"doc": doc, "kind": "binary", "dtype": dtype, "shape": shape})


def per_point(doc: str, dtype: str = "<f4", **default: Any) -> Any:
    """A dataclass field for a blob with one number per point, cluster or detection."""
    return array(dtype, ("N",), doc, **default)


def points(doc: str, dtype: str = "<f4", **default: Any) -> Any:
    """A dataclass field for a blob with x, y and z of any number of points."""
    return array(dtype, ("N", 3), doc, **default)


@dataclass_transform(
    kw_only_default=True,
    frozen_default=True,
    eq_default=False,
    field_specifiers=(field, column, array, per_point, points),
)
def row(*, eq: bool = False) -> Callable[[type[Row]], type[Row]]:
    """Make a class a frozen keyword-only dataclass: a row of a table, with its fields as columns."""
    return dataclass(frozen=True, eq=eq, kw_only=True)


@row()
class Recorded:
    """Last columns of every record table: vehicle, work and time of a record."""

    work_key: str = column("hash of code version, config, inputs", default="")
    recorded_at: str = column("UTC, ISO 8601 with microseconds: when the row was written", default="")
    asserted_at: str = column(
        "UTC, ISO 8601 with microseconds: when a night last made it current; the latest row of a subject is current",
        default="",
    )


_POSE = "T_a_b as quaternion (scalar first) and origin of b in a; null if there is no estimate"


@row()
class Posed(Recorded):
    """Columns of a record with an estimate T_a_b: the pose and its uncertainty."""

    qw: float | None = column(_POSE, default=None)
    qx: float | None = column(_POSE, default=None)
    qy: float | None = column(_POSE, default=None)
    qz: float | None = column(_POSE, default=None)
    tx_m: float | None = column(_POSE, default=None)
    ty_m: float | None = column(_POSE, default=None)
    tz_m: float | None = column(_POSE, default=None)
    covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "covariance of (rx ry rz tx ty tz), left perturbation in a's axes [rad, m]; null without an estimate",
        default=None,
    )
    common_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "part of the covariance from errors common to all days of a vehicle: bias floors, and the prior's error as far "
        "as estimates depend on it; the rest is independent from day to day",
        default=None,
    )
    observable: list[bool] | None = column(
        "per DoF: determined by the day (for a state: by one of its days); otherwise prior and prior sigma",
        default=None,
    )
    determined: list[str] = column(
        "certified directions, of azimuth and elevation at visible targets 15 to 40 m away: error below the "
        "limit with probability verify.confidence",
        default_factory=list,
    )
    azimuth_sigma_rad: float | None = column("sigma of a target's azimuth, from covariance", default=None)
    elevation_sigma_rad: float | None = column("sigma of a target's elevation, from covariance", default=None)


def _column(of: Field[Any], kind: Any) -> Column:
    """The column of a field; nullable if None is among its types."""
    nullable = type(None) in get_args(kind) if isinstance(kind, UnionType) else False
    plain = next(k for k in get_args(kind) if k is not type(None)) if nullable else kind
    known = dict(of.metadata)
    return Column(of.name, known.pop("kind", "") or _KINDS[plain], nullable=nullable, **known)
