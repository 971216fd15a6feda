"""The night on a lake in a bucket, while the store now and then answers 503: the same records as on a folder."""

import json

import numpy as np
import pytest

from pipeline.simulate.fleet import FleetSpec
from tests.makers.commands import boresight
from tests.makers.kept_days import kept_fleet
from tests.makers.s3_server import BUCKET, running


@pytest.mark.slow
def test_a_night_on_a_bucket_records_what_a_night_on_a_folder_does(tmp_path):
    kept_fleet(FleetSpec(vehicles=1, days=1, frames=12, drives=2), tmp_path)
    logs = f"{tmp_path}/logs/{{vehicle}}/{{day}}/*"
    common = ["--fleet", f"{tmp_path}/fleet.toml", "--executor", "inline", "--logs", logs, "--no-pictures"]
    records = {}
    with running() as s3:
        for lake in (f"{tmp_path}/lake", f"s3://{BUCKET}/night/lake"):
            s3.faults(fail=20, every=5)
            code, summary, _, stderr = boresight("nightly", "--lake", lake, *common, **s3.environment)
            assert code in (0, 3), stderr
            assert summary["vehicle_days"] == 1
            assert summary["damaged"] == []
            assert summary["report"].startswith(lake)
            shown = boresight("show", "calibrations", "--lake", lake, "--json", **s3.environment)
            records[lake] = json.loads(shown.out)
        # Of the bucket alone: `test_nightly` asks the same of a folder.
        assert boresight("nightly", "--lake", lake, *common, **s3.environment).summary["done"] == 0
        status = boresight("status", "--lake", lake, **s3.environment).summary
        assert status["failed"] + status["missing"] == 0
        assert s3.faults()["failed"] > 0
    here, there = records.values()
    assert len(here) == 3
    for a, b in zip(here, there, strict=True):
        for name in set(a) - {"recorded_at", "asserted_at"}:
            np.testing.assert_equal(a[name], b[name], err_msg=name)
