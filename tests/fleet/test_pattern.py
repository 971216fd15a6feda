import os

import pytest

from pipeline.core.errors import ConfigError
from pipeline.fleet.pattern import find_vehicle_days


def touch(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def found(pattern, root, *days):
    return {
        (d.partition.vehicle, d.partition.day): [str(p.relative_to(root)) for p in d.logs]
        for d in find_vehicle_days(str(root / pattern), *days)
    }


CAR = ("car", "2026-03-02")
DAY = "car/2026-03-02"
ONE = "my_car-1_2026-03-02_0"
LAYOUTS = {
    "folders": (
        "{vehicle}/{day}/*.mcap",
        [f"{DAY}/a.mcap", "car/2026-03-03/b.mcap", "bus/2026-03-02/c.mcap", f"{DAY}/notes.txt", "car/latest/a.mcap"],
        {("bus", "2026-03-02"): ["bus/2026-03-02/c.mcap"], CAR: [f"{DAY}/a.mcap"],
         ("car", "2026-03-03"): ["car/2026-03-03/b.mcap"]}),
    "inside names, containers mixed": (
        "{vehicle}_{day}_*",
        [f"{ONE}0.mcap", f"{ONE}1.bag", f"{ONE}2/metadata.yaml", f"{ONE}2/x.db3", f"{ONE}3/lost_metadata.db3",
         "my_car-1_2026-03-02_calibration.json", "my_car-1_2026-02-30_00.mcap"],
        {("my_car-1", "2026-03-02"): [f"{ONE}0.mcap", f"{ONE}1.bag", f"{ONE}2", f"{ONE}3"]}),
    "a folder stands for its logs": (
        "{vehicle}/{day}/", [f"{DAY}/{name}" for name in ("a.mcap", "b.bag", "readme.md")],
        {CAR: [f"{DAY}/a.mcap", f"{DAY}/b.bag"]}),
    "a bag beside a ROS 2 recording": (
        "{vehicle}/{day}", [f"{DAY}/{name}" for name in ("metadata.yaml", "rec_0.mcap", "rec_1.mcap", "older.bag")],
        {CAR: [DAY, f"{DAY}/older.bag"]}),
    "a range of letters": (
        "{vehicle}/{day}/a[0-1].mcap", [f"{DAY}/{n}.mcap" for n in ("a0", "a1", "a2", "b0")],
        {CAR: [f"{DAY}/a0.mcap", f"{DAY}/a1.mcap"]}),
    "any letter": (
        "{vehicle}/{day}/?0.mcap", [f"{DAY}/{n}.mcap" for n in ("a0", "a1", "b0")],
        {CAR: [f"{DAY}/a0.mcap", f"{DAY}/b0.mcap"]}),
}  # fmt: skip


@pytest.mark.parametrize(("pattern", "files", "days"), LAYOUTS.values(), ids=LAYOUTS)
def test_a_pattern_gives_each_log_to_its_vehicle_day(pattern, files, days, tmp_path):
    touch(*(tmp_path / file for file in files))
    assert found(pattern, tmp_path) == days


def test_days_are_filtered_and_come_in_order(tmp_path):
    touch(*(tmp_path / f"{v}/2026-03-0{d}/a.mcap" for v in ("b", "a") for d in (1, 2, 3)))
    pattern = str(tmp_path / "{vehicle}/{day}/*")
    days = find_vehicle_days(pattern, "2026-03-02", "2026-03-03")
    assert [(d.partition.day, d.partition.vehicle) for d in days] == [
        ("2026-03-02", "a"), ("2026-03-02", "b"), ("2026-03-03", "a"), ("2026-03-03", "b"),
    ]  # fmt: skip
    assert find_vehicle_days(pattern, "2027-01-01") == []


@pytest.mark.parametrize("stray", ["metadata.yaml", "notes.db3"])
def test_vehicles_that_share_a_folder_are_never_mixed_whatever_else_lies_there(stray, tmp_path):
    names = [f"car-{i}_2026-03-0{d}.{kind}" for i in (1, 2) for d in (2, 3) for kind in ("mcap", "db3")]
    touch(*(tmp_path / name for name in names), tmp_path / stray)
    assert found("{vehicle}_{day}.*", tmp_path) == {
        (f"car-{i}", f"2026-03-0{d}"): [f"car-{i}_2026-03-0{d}.db3", f"car-{i}_2026-03-0{d}.mcap"]
        for i in (1, 2)
        for d in (2, 3)
    }


def test_links_that_lead_round_in_a_circle_show_a_log_once_and_pipes_are_no_logs(tmp_path):
    touch(tmp_path / "car/2026-03-02/a.mcap")
    (tmp_path / "car/2026-03-02/again").symlink_to(tmp_path / "car/2026-03-02")
    os.mkfifo(tmp_path / "car/2026-03-02/pipe.mcap")
    assert found("{vehicle}/{day}/**/*.mcap", tmp_path) == {("car", "2026-03-02"): ["car/2026-03-02/a.mcap"]}


@pytest.mark.parametrize("pattern", ["{vehicle}/{day}/*.mcap", "{vehicle}/{day}", "{vehicle}/{day}/**"])
def test_a_link_to_a_lost_log_is_a_log_that_its_day_has_to_answer_for(pattern, tmp_path):
    touch(tmp_path / "car/2026-03-02/a.mcap")
    (tmp_path / "bus/2026-03-02").mkdir(parents=True)
    (tmp_path / "car/2026-03-02/b.mcap").symlink_to(tmp_path / "unmounted/b.mcap")
    (tmp_path / "bus/2026-03-02/a.mcap").symlink_to("a.mcap")  # to itself
    (tmp_path / "bus/2026-03-02/notes").symlink_to(tmp_path / "unmounted/notes")
    assert found(pattern, tmp_path) == {
        ("bus", "2026-03-02"): ["bus/2026-03-02/a.mcap"],
        ("car", "2026-03-02"): ["car/2026-03-02/a.mcap", "car/2026-03-02/b.mcap"],
    }


@pytest.mark.parametrize(
    ("pattern", "days", "match"),
    [
        ("{vehicle}/*.mcap", (), r"lacks \{day\}"),
        ("{day}/*.mcap", (), r"lacks \{vehicle\}"),
        ("{vehicle}/{date}/{day}", (), r"\{date\}"),
        ("{vehicle}/{day}/*.nothing", (), "no log matches"),
        ("{vehicle}/{day}/*", ("yesterday",), "--from"),
        ("{vehicle}/{day}/*", ("2026-03-03", "2026-03-02"), "after --to"),
    ],
)
def test_what_cannot_be_meant_is_refused(pattern, days, match, tmp_path):
    touch(tmp_path / "car/2026-03-02/a.mcap")
    with pytest.raises(ConfigError, match=match) as caught:
        find_vehicle_days(str(tmp_path / pattern), *days)
    assert caught.value.exit_code == 2
