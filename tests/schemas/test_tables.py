"""What is true of every table: its columns, and the schemas that are written of them."""

import base64
import json

import jsonschema
import numpy as np
import pytest

from schemas.columns import TableSchema
from schemas.versions import TABLES, write_json_schemas


@pytest.fixture(params=TABLES.values(), ids=lambda t: t.name)
def table(request) -> TableSchema:
    return request.param


def test_every_column_is_documented(table):
    assert all(c.doc for c in table.columns)


def test_the_arrow_schema_tells_dtype_and_shape_of_every_array(table):
    for field, column in zip(table.arrow_schema(), table.columns, strict=True):
        assert field.name == column.name
        assert field.nullable == column.nullable
        if column.is_array:
            assert np.dtype(field.metadata[b"dtype"].decode()).byteorder in "<|="
            assert all(s == "N" or int(s) > 0 for s in field.metadata[b"shape"].decode().split(","))
            assert sum(s == "N" for s in column.shape) <= 1


def json_value(column):
    """A value as JSON carries it."""
    value = {
        "int64": 3, "int32": 3, "float64": 0.5, "string": "x", "bool": True,
        "binary": base64.b64encode(b"abc").decode(), "list<string>": ["a"], "list<float64>": [0.5],
        "list<bool>": [True], "map<string,float64>": {"a": 0.5}, "map<string,int64>": {"a": 1},
    }  # fmt: skip
    return value[column.kind]


def test_the_exported_json_schema_accepts_rows_and_refuses_others(table, tmp_path):
    paths = {p.name: p for p in write_json_schemas(tmp_path / "out")}
    schema = json.loads(paths[f"{table.name}.schema.json"].read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["title"] == f"{table.name}/{table.version}"
    check = jsonschema.Draft202012Validator(schema)
    row = {c.name: json_value(c) for c in table.columns}
    check.validate(row)
    check.validate({c.name: None if c.nullable else row[c.name] for c in table.columns})
    name = next(c.name for c in table.columns if not c.nullable)
    for wrong in ({**row, name: None}, {**row, "colour": 1}, {k: v for k, v in row.items() if k != name}):
        assert not check.is_valid(wrong)


def test_columns_with_a_dimension_carry_their_unit(table):
    angles = [c for c in table.columns if "azimuth" in c.name or "rotation" in c.name]
    lengths = [c for c in table.columns if c.name.split("_")[-1] in ("tx", "ty", "tz", "xyz", "range")]
    assert all(c.name.endswith("_rad") for c in angles)
    assert lengths == []


def test_a_table_does_not_invent_columns(table):
    with pytest.raises(KeyError, match="no column colour"):
        table.column("colour")
