"""No thread of Arrow's may hold an object of Python's: it would abort a process that ends just then."""

import threading

import numpy as np
import pytest

import pipeline.store.object_store
from pipeline.store.commits import commit_records
from pipeline.store.files import LocalFiles
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.row_groups import read_columns, read_group, row_groups
from pipeline.store.tables import read_rows, write_partition
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.makers.s3_server import BUCKET, running
from tests.makers.table_rows import make_row
from tests.makers.whole_tables import FRAMES, WholeFrame

DAY = Partition("car", "2026-03-02")


def fill_and_read(lake):
    """Write a partition and a record, and read them in every way there is."""
    rng = np.random.default_rng(0)
    with write_partition(lake, FRAMES, DAY, "key", "0.1") as writer:
        writer.append([make_row("frames", rng, frame_index=i) for i in range(3)])
    values = {"recorded_at": "", "asserted_at": "", "vehicle": "car", "day": DAY.day, "work_key": "A"}
    commit_records(lake, CALIBRATIONS, [make_row("calibrations", rng, **values)])

    def read():
        groups = row_groups(lake, FRAMES, DAY)
        return (
            len(read_rows(lake, FRAMES, DAY, WholeFrame)),
            len(read_columns(lake, FRAMES, DAY, ["frame_index"])["frame_index"]),
            len(read_group(lake, FRAMES, groups[0], WholeFrame)),
            len(read_records(lake, CALIBRATIONS, CalibrationRecord)),
        )

    return read


def test_files_of_a_folder_are_read_without_any_object_of_python(tmp_path, monkeypatch):
    read = fill_and_read(Lake.at(tmp_path))
    monkeypatch.setattr(LocalFiles, "opened", lambda *_: pytest.fail("opened as a Python stream"))
    assert read() == (3, 3, 3, 1)


def test_objects_of_a_bucket_are_read_in_the_callers_thread_alone(monkeypatch):
    readers = set()
    real = pipeline.store.object_store._Reader.readinto

    def noted(self, buffer):
        readers.add(threading.get_ident())
        return real(self, buffer)

    with running() as s3:
        for name, value in s3.environment.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(pipeline.store.object_store._Reader, "readinto", noted)
        assert fill_and_read(Lake.at(f"s3://{BUCKET}/lakes/threads"))() == (3, 3, 3, 1)
    assert readers == {threading.get_ident()}
