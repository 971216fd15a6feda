"""Names of partitions, their places, and the keys of work."""

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
def test_any_vehicle_name_makes_one_folder_of_that_table(name):
    folder = Partition(name, "2026-03-02").folder
    assert folder.count("/") == 1
    assert ".." not in Path(folder).parts
    assert not {"*", "["} & set(folder)


def test_partitions_are_found_by_table(tmp_path):
    lake = Lake.at(tmp_path)
    wanted = [Partition("a b", "2026-03-02"), Partition("a b", "2026-03-03"), Partition("ü%", "2026-03-02")]
    for folder in (*(lake.folder("frames", p) for p in wanted), tmp_path / "frames/vehicle=x/day=today"):
        folder.mkdir(parents=True)
        (folder / "part-0.parquet").touch()
    (tmp_path / "frames/vehicle=y/day=2026-03-02").mkdir(parents=True)
    assert lake.partitions("frames") == wanted
    assert lake.partitions("drift") == []


@pytest.mark.parametrize(
    ("vehicle", "day", "match"),
    [
        *((vehicle, "2026-03-02", "vehicle") for vehicle in ("", "a/b", "..", "a=b", "a\0")),
        *(
            ("car", day, "YYYY-MM-DD")
            for day in ("", "2026-02-30", "20260302", "2026-W10-1", "2026-3-2", "../x", "2026-03-02\n")
        ),
    ],
)
def test_impossible_names_of_vehicles_and_days_are_refused(vehicle, day, match):
    with pytest.raises(ConfigError, match=match):
        Partition(vehicle, day)


def test_work_keys_change_with_every_input_and_only_then():
    base = work_key("ingest", "1", "c", ["a", "b"])
    assert base == work_key("ingest", "1", "c", ["b", "a"])
    others = [
        ("perceive", "1", "c", ["a", "b"]), ("ingest", "2", "c", ["a", "b"]), ("ingest", "1", "d", ["a", "b"]),
        ("ingest", "1", "c", ["a"]), ("ingest", "1", "c", ["a", "b", "b"]),
    ]  # fmt: skip
    assert len({base, *(work_key(*other) for other in others)}) == 6


@pytest.mark.parametrize("place", ["s3://", "s3://bucket", "gs://bucket/lake", "https://example.com/lake"])
def test_a_place_that_is_no_folder_and_no_prefix_of_a_bucket_is_a_usage_error(place):
    with pytest.raises(ConfigError, match=r"neither a folder nor s3://BUCKET/PREFIX"):
        Lake.at(place)


def test_what_works_on_folders_only_says_so():
    lake = Lake.at("s3://bucket/fleet/lake")
    assert str(lake) == "s3://bucket/fleet/lake"
    with pytest.raises(ConfigError, match="is not a folder"):
        _ = lake.local_root
