from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Lake, Partition, work_key

names = st.text(
    st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="/=\0"), min_size=1, max_size=16
)


@given(names.filter(lambda n: n not in (".", "..")))
def test_any_vehicle_name_makes_one_folder_that_leads_back_to_it(name):
    folder = Partition(name, "2026-03-02").folder
    assert folder.count("/") == 1
    assert ".." not in Path(folder).parts
    assert "*" not in folder
    assert "[" not in folder


def test_partitions_are_found_by_table_vehicle_and_day(tmp_path):
    lake = Lake.at(tmp_path)
    wanted = [Partition("a b", "2026-03-02"), Partition("a b", "2026-03-03"), Partition("ü%", "2026-03-02")]
    for partition in wanted:
        folder = lake.folder("frames", partition)
        folder.mkdir(parents=True)
        (folder / "part-0.parquet").touch()
    for stray in ("frames/vehicle=x/day=today", "frames/vehicle=y/day=2026-03-02"):
        (tmp_path / stray).mkdir(parents=True)
    (tmp_path / "frames/vehicle=x/day=today/part-0.parquet").touch()
    assert lake.partitions("frames") == wanted
    assert lake.partitions("frames", vehicle="a b") == wanted[:2]
    assert lake.partitions("frames", day="2026-03-02") == [wanted[0], wanted[2]]
    assert lake.partitions("frames", "ü%", "2026-03-02") == [wanted[2]]
    assert lake.partitions("drift") == []


@pytest.mark.parametrize("vehicle", ["", "a/b", "..", "a=b", "a\0"])
def test_impossible_vehicle_names_are_refused(vehicle):
    with pytest.raises(ConfigError, match="vehicle"):
        Partition(vehicle, "2026-03-02")


@pytest.mark.parametrize(
    "day", ["", "2026-02-30", "20260302", "2026-W10-1", "2026-3-2", "../x", "2026-03-02\n"]
)
def test_days_have_one_spelling(day):
    with pytest.raises(ConfigError, match="YYYY-MM-DD"):
        Partition("car", day)


def test_work_keys_change_with_every_input_and_only_then():
    base = work_key("ingest", "1", "c", ["a", "b"])
    assert base == work_key("ingest", "1", "c", ["b", "a"])
    others = [
        work_key("perceive", "1", "c", ["a", "b"]),
        work_key("ingest", "2", "c", ["a", "b"]),
        work_key("ingest", "1", "d", ["a", "b"]),
        work_key("ingest", "1", "c", ["a"]),
        work_key("ingest", "1", "c", ["a", "b", "b"]),
    ]
    assert len({base, *others}) == 6


@pytest.mark.parametrize("location", ["s3://", "s3://bucket", "gs://bucket/lake", "https://example.com/lake"])
def test_what_is_neither_a_folder_nor_a_place_in_s3_is_refused_in_words(location):
    with pytest.raises(ConfigError, match="neither a folder nor s3://"):
        Lake.at(location)
    assert str(Lake.at("s3://bucket/fleet/lake")) == "s3://bucket/fleet/lake"
