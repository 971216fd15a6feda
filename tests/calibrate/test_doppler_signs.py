"""A day of a car with radars alone: a wrong Doppler sign is named on its own radar and turns no other."""

import json
from pathlib import Path

import numpy as np
import pytest

from jobs.cli import main
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.radar_cars import FRONT, REAR, radar_log, with_sign

CAR = {"back": REAR, "front": FRONT}  # in the order in which the car's speed is looked for
DAY = "2023-11-14"


@pytest.fixture(scope="module", params=["odometry", "radars alone"])
def car(request, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("car")
    log = radar_log(folder / "a.mcap", CAR, odometry=request.param == "odometry", frames=60)
    assert main(["init", str(log), "--out", str(folder / "fleet.toml")]) == 0
    return folder


def day(folder: Path, lake: str, capsys) -> dict[str, dict]:
    """Records of the day by radar."""
    where = ["--lake", str(folder / lake), "--vehicle", "car", "--day", DAY]
    of_fleet = ["--fleet", str(folder / "fleet.toml"), *where]
    assert main(["ingest", *of_fleet, str(folder / "a.mcap")]) == 0
    assert main(["perceive", *of_fleet]) == 0
    assert main(["calibrate", *of_fleet]) == 3
    capsys.readouterr()
    assert main(["show", "calibrations", "--lake", str(folder / lake), "--json"]) == 0
    return {r["parent_frame"]: r for r in json.loads(capsys.readouterr().out)}


def yaw_sigmas(record: dict, yaw_deg: float) -> float:
    """How far the radar of a record looks from where it looks on the car, in sigmas of the record."""
    T_radar_base = np.array(record["T"])
    found = np.degrees(np.arctan2(T_radar_base[0, 1], T_radar_base[0, 0]))
    return float(abs((found - yaw_deg + 180) % 360 - 180) / np.degrees(record["azimuth_sigma_rad"]))


def test_with_the_signs_that_init_writes_every_radar_looks_where_it_is_mounted(car, capsys):
    records = day(car, "right", capsys)
    for name, radar in CAR.items():
        assert records[name]["faults"] == []
        assert yaw_sigmas(records[name], radar.yaw_deg) < 3
    rows = list(observations_of(Lake.at(car / "right"), Partition("car", DAY), chosen={"radar": "back"}))
    assert len(rows) == 60
    assert all(o.ego_speed_mps is not None and 7 < o.ego_speed_mps < 15 for o in rows)


def test_a_rear_radar_of_the_wrong_sign_is_held_for_it_and_turns_no_other(car, capsys):
    right = (car / "fleet.toml").read_text()
    with_sign(car / "fleet.toml", "back", "approaching")
    try:
        records = day(car, "wrong", capsys)
    finally:
        (car / "fleet.toml").write_text(right)
    assert (records["back"]["status"], records["back"]["faults"]) == ("held", ["doppler"])
    assert "doppler_positive in fleet.toml" in records["back"]["reason"]
    front = records["front"]
    assert front["faults"] == []
    if front["status"] == "refused":  # without odometry no other source is left
        assert front["reason"].endswith("the car's motion: the car drives backwards by back")
    else:
        assert yaw_sigmas(front, FRONT.yaw_deg) < 3
