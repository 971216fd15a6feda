"""A lake in a bucket while the store answers 503, late or not at all; only what is asked for is fetched."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pipeline.store.object_store
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Partition
from pipeline.store.tables import read_columns, read_manifest, read_rows, write_partition
from schemas.calibrations import CALIBRATIONS, PAIRS
from tests.makers.s3_server import running
from tests.makers.table_rows import make_record, make_row, read_calibrations
from tests.makers.whole_tables import FRAMES, WholeFrame

REPO = Path(__file__).resolve().parents[2]
DAY = Partition("bus 7%", "2026-03-02")  # a name that must be quoted


@pytest.fixture
def lake(bucket_lake):
    return bucket_lake


def write(lake, rows, key="k1"):
    with write_partition(lake, FRAMES, DAY, key, ["in"]) as writer:
        for first in range(0, len(rows), 2):
            writer.append(rows[first : first + 2])


def test_only_what_is_asked_for_is_fetched(lake, rng, s3):
    write(lake, [make_row("frames", rng, image=rng.bytes(3 << 20)) for _ in range(8)])
    before = s3.faults(fail=0)["bytes_sent"]
    read_columns(lake, FRAMES, DAY, ["frame_index"])
    assert 0 < s3.faults(fail=0)["bytes_sent"] - before < 8 << 20  # of 24 MiB


@pytest.mark.parametrize(
    "fault",
    [
        {"fail": 6}, {"stall": 2, "stall_s": 3.0}, {"fail": 40, "every": 3},
        {"mix": ["500", "lost"], "every": 4},
    ],
)  # fmt: skip
def test_answers_of_5xx_late_ones_and_lost_ones_are_asked_for_again(fault, lake, rng, s3, monkeypatch):
    monkeypatch.setattr(pipeline.store.object_store, "REQUEST_S", 2.0)
    pipeline.store.object_store._client.cache_clear()
    rows = [make_row("frames", rng, frame_index=i) for i in range(3)]
    before = s3.faults(**fault)
    write(lake, rows)
    commit_records(lake, CALIBRATIONS, [make_record(rng, "k", pair=pair) for pair in PAIRS])
    assert len(read_rows(lake, FRAMES, DAY, WholeFrame)) == len(read_calibrations(lake)) == 3
    after = s3.faults(fail=0, stall=0)
    assert sum(after[kind] - before[kind] for kind in ("failed", "stalled", "lost")) > 1
    assert lake.damage == []


def test_a_store_that_is_down_is_an_error_and_never_damage(lake, rng, s3, monkeypatch):
    write(lake, [make_row("frames", rng)])
    commit_records(lake, CALIBRATIONS, [make_record(rng, "k")])
    monkeypatch.setattr(pipeline.store.object_store, "RETRIES", 1)
    pipeline.store.object_store._client.cache_clear()
    s3.faults(fail=10_000)
    for call in (
        lambda: read_manifest(lake, FRAMES, DAY),
        lambda: read_calibrations(lake),
        lambda: commit_records(lake, CALIBRATIONS, [make_record(rng, "k2")]),
        lambda: write(lake, [make_row("frames", rng)], key="k2"),
    ):
        with pytest.raises(OSError, match="s3://") as caught:
            call()
        assert caught.value.errno is None or caught.value.errno > 0
    s3.faults(fail=0)
    assert lake.damage == []
    assert [r.work_key for r in read_calibrations(lake)] == ["k"]
    assert read_manifest(lake, FRAMES, DAY).work_key == "k1"


def test_a_bucket_of_the_same_name_in_another_store_is_another_one(lake, rng, monkeypatch):
    write(lake, [make_row("frames", rng)])
    with running() as other:
        monkeypatch.setenv("AWS_ENDPOINT_URL", other.environment["AWS_ENDPOINT_URL"])
        assert read_manifest(lake, FRAMES, DAY) is None


_COMMITS = """
import sys, numpy as np
from pipeline.store.partitions import Lake
from pipeline.store.commits import commit_records
from schemas.calibrations import CALIBRATIONS
from tests.makers.table_rows import make_record
lake, rng, name = Lake.at(sys.argv[1]), np.random.default_rng(0), sys.argv[2]
for i in range(5):
    commit_records(lake, CALIBRATIONS, [make_record(rng, f"{name}{i}"), make_record(rng, "shared", vehicle="bus")])
"""


@pytest.mark.slow
def test_two_writers_at_once_both_get_their_records_in(any_lake):
    environment = os.environ | {"PYTHONPATH": str(REPO)}
    commands = [[sys.executable, "-c", _COMMITS, str(any_lake), name] for name in "ab"]
    writers = [subprocess.Popen(command, env=environment) for command in commands]
    assert [w.wait(600) for w in writers] == [0, 0]
    of_both = sorted(f"{name}{i}" for name in "ab" for i in range(5))
    assert sorted(r.work_key for r in read_calibrations(any_lake, vehicle="car")) == of_both
    assert [r.work_key for r in read_calibrations(any_lake, vehicle="bus")] == ["shared"]
