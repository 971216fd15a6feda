"""A few kills of the soak (`tests/benchmarks/studies/soak.py` has hundreds), and that it sees what it looks for."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.benchmarks.studies.soak import FAULTS, Soak, contents, differences, make_fleet, soak_round, storage
from tests.benchmarks.studies.victims import CROWDS
from tests.makers.s3_server import BUCKET


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "kills"), [("folder", 1), ("s3", 1)])
def test_nights_that_are_killed_leave_what_an_undisturbed_one_leaves(kind, kills, tmp_path, monkeypatch):
    for name in (
        "AWS_ACCESS_KEY_ID",
        "AWS_SECRET_ACCESS_KEY",
        "AWS_REGION",
        "AWS_ENDPOINT_URL",
        "AWS_ALLOW_HTTP",
    ):
        monkeypatch.setenv(name, "")  # given back after the test
    make_fleet(tmp_path, days=1)
    with storage(kind) as s3, CROWDS["process"](tmp_path / "tmp") as crowd:
        soak = Soak(tmp_path, crowd, faults=FAULTS | {"mix": ["503", "500", "slow", "lost"], "slow_s": 0.3})
        lakes = str(tmp_path) if s3 is None else f"s3://{BUCKET}"
        soak.undisturbed(f"{lakes}/quiet")
        quiet = Lake.at(f"{lakes}/quiet")
        wanted = contents(quiet)
        assert len([key for key in wanted if key.startswith("calibrations")]) == 9
        assert len([key for key in wanted if key.startswith("page")]) == 1 + 3
        told = soak_round(soak, f"{lakes}/disturbed", kills, np.random.default_rng(5), wanted, s3)
        assert (told.kills, told.differences) == (kills, [])
        if s3 is not None:
            assert min(told.requests[fault] for fault in ("failed", "slowed", "lost")) > 1
        else:
            planted_differences_are_seen(soak, quiet, wanted)


def planted_differences_are_seen(soak, lake, wanted):
    assert differences(soak, lake, wanted) == []
    record = read_records(lake, CALIBRATIONS, CalibrationRecord)[0]
    commit_records(lake, CALIBRATIONS, [replace(record, work_key="other", recorded_at="", asserted_at="")])
    frames = next(iter(lake.files.find(lake.root / "sweeps", "*/*/*.parquet")))
    frames.write_bytes(frames.read_bytes() + b" ")
    next(iter(lake.files.find(lake.root / "report", "*/*/*.html"))).unlink()
    (frames.parent / ".writing-host-1-x.tmp").touch()
    found = differences(soak, lake, wanted)
    assert sorted(line.split(":")[0] for line in found) == ["differs", "left over", "lost", "too much"]
