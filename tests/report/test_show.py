"""`boresight show`: records as JSON and nothing else."""

import json

import numpy as np
import pytest

from jobs.show import show
from pipeline.core.errors import ConfigError
from pipeline.rig.se3 import from_quaternion
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.makers.lakes import write_records


@pytest.fixture
def lake(tmp_path):
    """Two days of one vehicle, the first calibrated twice; the second refused."""
    rng = np.random.default_rng(1)
    for key in ("first", "second"):
        rows = vehicle_records("v", 1, rng)
        write_records(Lake.at(tmp_path), CALIBRATIONS, rows, key)
    rows = [r for r in vehicle_records("v", 2, rng, status=lambda _: "refused") if r.day == "2026-03-02"]
    write_records(Lake.at(tmp_path), CALIBRATIONS, rows, "third")
    return tmp_path


def test_json_has_every_column_and_the_transform_as_a_matrix(lake, capsys):
    assert show("calibrations", lake=str(lake), json=True) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 9
    for row in rows:
        assert set(row) == {c.name for c in CALIBRATIONS.columns} | {"T"}
        if row["status"] == "refused":
            assert row["T"] is None
            continue
        q, t = [row[f"q{k}"] for k in "wxyz"], [row[f"t{k}_m"] for k in "xyz"]
        np.testing.assert_allclose(row["T"], from_quaternion(np.array(q), np.array(t)), atol=1e-12)
        assert np.shape(row["covariance"]) == (6, 6)


def test_filters_choose_vehicle_day_and_method(lake, capsys):
    for kwargs, count in (
        ({"vehicle": "v", "day": "2026-03-01"}, 6),
        ({"vehicle": "v", "day": "2026-03-01", "current": True}, 3),
        ({"method": "tracking"}, 0),
        ({"vehicle": "w"}, 0),
    ):
        assert show("calibrations", lake=str(lake), json=True, **kwargs) == 0
        assert len(json.loads(capsys.readouterr().out)) == count


def test_a_lake_without_records_is_an_empty_list(tmp_path, capsys):
    for table in ("calibrations", "drift", "moments", "perceived"):
        assert show(table, lake=str(tmp_path), json=True) == 0
        assert json.loads(capsys.readouterr().out) == []
        assert show(table, lake=str(tmp_path)) == 0
        assert capsys.readouterr().out == f"{table}: no matching rows in {tmp_path}\n"


def test_a_lake_that_is_not_there_is_a_usage_error_and_not_an_empty_fleet(tmp_path):
    with pytest.raises(ConfigError, match="no such folder") as caught:
        show("calibrations", lake=str(tmp_path / "lkae"), json=True)
    assert caught.value.exit_code == 2
