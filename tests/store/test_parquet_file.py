"""No thread of Arrow's may hold an object of Python's: it would abort a process that ends just then."""

import threading

import numpy as np
import pytest

import pipeline.store.object_store
from pipeline.store.commits import commit_records
from pipeline.store.files import LocalFiles
from pipeline.store.partitions import Partition
from pipeline.store.tables import read_columns, read_group, read_rows, row_groups, write_partition
from schemas.calibrations import CALIBRATIONS
from tests.makers.table_rows import make_record, make_row, read_calibrations
from tests.makers.whole_tables import FRAMES, WholeFrame

DAY = Partition("car", "2026-03-02")


def fill_and_read(lake):
    """Write a partition and a record, and read them in every way there is."""
    rng = np.random.default_rng(0)
    with write_partition(lake, FRAMES, DAY, "key") as writer:
        writer.append([make_row("frames", rng, frame_index=i) for i in range(3)])
    commit_records(lake, CALIBRATIONS, [make_record(rng, "A")])

    def read():
        columns = read_columns(lake, FRAMES, DAY, ["frame_index"])["frame_index"]
        group = read_group(lake, FRAMES, row_groups(lake, FRAMES, DAY)[0], WholeFrame)
        rows = read_rows(lake, FRAMES, DAY, WholeFrame), columns, group, read_calibrations(lake)
        return tuple(map(len, rows))

    return read


def test_files_of_a_folder_are_read_without_any_object_of_python(lake, monkeypatch):
    read = fill_and_read(lake)
    monkeypatch.setattr(LocalFiles, "opened", lambda *_: pytest.fail("opened as a Python stream"))
    assert read() == (3, 3, 3, 1)


def test_objects_of_a_bucket_are_read_in_the_callers_thread_alone(bucket_lake, monkeypatch):
    readers = set()
    real = pipeline.store.object_store._Reader.readinto

    def noted(self, buffer):
        readers.add(threading.get_ident())
        return real(self, buffer)

    monkeypatch.setattr(pipeline.store.object_store._Reader, "readinto", noted)
    assert fill_and_read(bucket_lake)() == (3, 3, 3, 1)
    assert readers == {threading.get_ident()}
