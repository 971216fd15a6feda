"""How a table is described once, by the dataclass of its rows, and what follows: Arrow schema and JSON Schema.

A row's fields are the table's columns (`column`, `array`); `TableSchema` is the table of them.

Arrays travel as `binary` blobs, one per attribute, little-endian and C-ordered
(Parquet reads them 4-10x faster than list columns); the column's Arrow field metadata says dtype and shape, so any
engine can decode them: `numpy.frombuffer(blob, dtype).reshape(shape)`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, field, fields
from types import UnionType
from typing import Any, Literal, TypeVar, dataclass_transform, get_args, get_type_hints

import numpy as np
import pyarrow as pa

__all__ = ["Column", "Posed", "Recorded", "TableSchema", "array", "column", "per_point", "points", "row"]

Row = TypeVar("Row")

ScalarKind = Literal["int64", "int32", "float64", "string", "bool", "binary", "list<string>", "list<float64>",
                     "list<bool>", "map<string,float64>", "map<string,int64>"]  # fmt: skip

# Of each kind: the type in Arrow, and in JSON Schema.
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
_KINDS: dict[Any, ScalarKind] = {
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
    """One column: its name carries the unit; `shape` is set for arrays, with "N" for the free axis."""

    name: str
    kind: ScalarKind
    doc: str
    nullable: bool = False
    dtype: str | None = None
    shape: tuple[str | int, ...] = ()

    @property
    def is_array(self) -> bool:
        """True for a blob that decodes to an array."""
        return self.dtype is not None

    def arrow_field(self) -> pa.Field:
        """The Arrow field, with dtype and shape in its metadata where the column is an array."""
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
    """A table: a column for each field of its rows. The version grows with every change that a reader can notice."""

    row_type: type = field(compare=False, repr=False)
    name: str
    version: int
    doc: str = ""
    made_by: str = ""  # stage, and command, that writes it
    # Older versions whose rows are read too: what they lack has a default in the row's dataclass.
    reads_versions: tuple[int, ...] = ()
    # Of a record table: the columns that say what a row is about. Of all rows about the same, the one that was asserted
    # last is current; work_key tells them apart. Empty: a table of partitions that are replaced as a whole.
    about: tuple[str, ...] = ()
    # Of a column that older releases did not write: the column that it follows from, and its value by that one's.
    follows: Mapping[str, tuple[str, Mapping[str, str]]] = field(default_factory=dict, hash=False)
    of_sensor: bool = False  # a partition has a file per sensor, joined by another table
    before: str = ""  # the table that stood in its place before 0.11
    columns: tuple[Column, ...] = ()  # left out: of its fields, in their order, inherited ones after its own

    def __post_init__(self) -> None:
        if self.columns:
            return
        bases = reversed([*enumerate(self.row_type.__mro__)])
        of_base = {name: k for k, base in bases for name in vars(base).get("__annotations__", ())}
        types = get_type_hints(self.row_type)
        ordered = sorted(fields(self.row_type), key=lambda f: of_base[f.name])
        object.__setattr__(self, "columns", tuple(_column(f, types[f.name]) for f in ordered))

    @property
    def is_record_table(self) -> bool:
        """True for a table of records, which are added; False for one of partitions, which are replaced."""
        return bool(self.about)

    def about_of(self, row: Any) -> tuple[str, ...]:
        """What a row of a record table is about: its values of those columns."""
        return tuple(getattr(row, name) for name in self.about)

    def rows_among(self, rows: Iterable[Any]) -> list[Any]:
        """Of rows of several tables, this one's."""
        return [row for row in rows if type(row) is self.row_type]

    def arrow_schema(self) -> pa.Schema:
        """The Arrow schema that every file of the table has."""
        return pa.schema([c.arrow_field() for c in self.columns])

    def column(self, name: str) -> Column:
        """The column of that name; KeyError where the table has none."""
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(f"table {self.name} has no column {name}")

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
    """A field that is a plain column.

    Args:
        doc: what it holds.
        kind: where the field's type leaves it open (int32); else it follows from that.
        default: `default` or `default_factory`, as of a dataclass.
    """
    return field(**default, metadata={"doc": doc, "kind": kind})


def array(dtype: str, shape: tuple[str | int, ...], doc: str, **default: Any) -> Any:
    """A field that is a blob: little-endian numpy `dtype` (as "<f4"), `shape` with "N" for the free axis."""
    return field(**default, metadata={"doc": doc, "kind": "binary", "dtype": dtype, "shape": shape})


def per_point(doc: str, dtype: str = "<f4", **default: Any) -> Any:
    """A field that is a blob with a number for each point, cluster or detection."""
    return array(dtype, ("N",), doc, **default)


def points(doc: str, dtype: str = "<f4", **default: Any) -> Any:
    """A field that is a blob with x, y and z of any number of points."""
    return array(dtype, ("N", 3), doc, **default)


@dataclass_transform(
    kw_only_default=True,
    frozen_default=True,
    eq_default=False,
    field_specifiers=(field, column, array, per_point, points),
)
def row(*, eq: bool = False) -> Callable[[type[Row]], type[Row]]:
    """A frozen dataclass of named fields only: a row of a table, whose columns its fields are."""
    return dataclass(frozen=True, eq=eq, kw_only=True)


@row()
class Recorded:
    """Columns of every record table, its last ones: whose, by which work, and since when it counts."""

    work_key: str = column("hash of code version, config, inputs", default="")
    recorded_at: str = column("UTC, ISO 8601 with microseconds: when the row was written", default="")
    asserted_at: str = column(
        "UTC, ISO 8601 with microseconds: when a night last made it current: of all rows about the same, the latest is",
        default="",
    )


_POSE = "of the estimate T_a_b: a quaternion, scalar first, and b's origin in a; null where there is none"


@row()
class Posed(Recorded):
    """Columns of a record that estimates T_a_b, after its own: the pose, and how sure it is."""

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
        "of (rx ry rz tx ty tz), left perturbation in a's axes [rad, m]; null where there is no estimate",
        default=None,
    )
    common_covariance: np.ndarray | None = array(
        "<f8",
        (6, 6),
        "the part of it that all days of a vehicle err by alike: bias floors, and the prior where the days leave it "
        "its weight; covariance less it varies from day to day and averages down",
        default=None,
    )
    observable: list[bool] | None = column(
        "per DoF: the day, of a state one of its days, determined it; else it keeps prior and prior sigma",
        default=None,
    )
    determined: list[str] = column(
        "of azimuth and elevation at targets 15 to 40 m away that the sensors see: those whose error is below the "
        "limit with probability verify.confidence",
        default_factory=list,
    )
    azimuth_sigma_rad: float | None = column("sigma of a target's azimuth, from the covariance", default=None)
    elevation_sigma_rad: float | None = column("sigma of its elevation", default=None)


def _column(of: Field[Any], kind: Any) -> Column:
    """The column of a field: nullable where None is among its types."""
    nullable = type(None) in get_args(kind) if isinstance(kind, UnionType) else False
    plain = next(k for k in get_args(kind) if k is not type(None)) if nullable else kind
    known = dict(of.metadata)
    return Column(of.name, known.pop("kind", "") or _KINDS[plain], nullable=nullable, **known)
