"""Each radar is asked for its Doppler's sign in the direction in which it looks by tf."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from jobs.cli import main
from tests.makers.radar_cars import CORNER, FRONT, REAR, radar_log, with_sign

CAR = {"front": FRONT, "rear": REAR, "corner": CORNER}
DAY = "2023-11-14"


def logged(folder: Path, radars, **drive) -> Path:
    return radar_log(folder / "logs" / "car" / DAY / "a.mcap", radars, **drive)


def proposed(log: Path, capsys) -> tuple[dict, dict]:
    """fleet.toml that `init` writes, and its summary."""
    out = log.parents[3] / "fleet.toml"
    assert main(["init", str(log), "--out", str(out)]) == 0
    return tomllib.loads(out.read_text()), json.loads(capsys.readouterr().out.splitlines()[-1])


def signs(values: dict) -> dict[str, str | None]:
    return {n: r.get("doppler_positive") for n, r in values["rigs"]["default"]["radars"].items()}


def checked(fleet: Path, *logs: Path, capsys) -> tuple[int, dict]:
    code = main(["check", str(fleet), *map(str, logs), "--json"])
    return code, json.loads(capsys.readouterr().out)


def reasons(report: dict, pair: str) -> str:
    return "; ".join(r for v in report["verdicts"] if v["pair"] == pair for r in v["reasons"])


@pytest.mark.parametrize(("odometry", "positive"), [(True, "approaching"), (False, "receding")])
def test_radars_to_the_rear_and_at_a_corner_get_the_sign_of_the_one_in_front(
    tmp_path, capsys, odometry, positive
):
    car = {name: replace(radar, positive=positive) for name, radar in CAR.items()}
    values, summary = proposed(logged(tmp_path, car, odometry=odometry, frames=40), capsys)
    assert signs(values) == dict.fromkeys(car, positive)
    assert summary["to_enter"] == []
    assert summary["problems"] == []


def test_a_rear_radars_wrong_sign_is_named_with_the_right_one_and_costs_its_own_edge(tmp_path, capsys):
    log = logged(tmp_path, CAR, odometry=False, frames=40)
    proposed(log, capsys)
    code, report = checked(tmp_path / "fleet.toml", log, capsys=capsys)
    assert code == 0
    code, report = checked(with_sign(tmp_path / "fleet.toml", "rear", "approaching"), log, capsys=capsys)
    assert code == 1
    assert 'doppler_positive of rear is probably "receding"' in reasons(report, "rear-base")
    for other in ("front-base", "corner-base"):
        assert "doppler_positive" not in reasons(report, other)
        assert any(v["verdict"] != "no" for v in report["verdicts"] if v["pair"] == other)


def test_radars_that_need_different_signs_are_named_with_what_to_correct(tmp_path, capsys):
    car = CAR | {"rear": replace(REAR, told_yaw_deg=0.0)}  # tf has it look ahead
    log = logged(tmp_path, car, frames=40)
    values, summary = proposed(log, capsys)
    assert signs(values) == {"front": "receding", "corner": "receding", "rear": "approaching"}
    (problem,) = summary["problems"]
    assert 'corner, front "receding" and rear "approaching"' in problem
    assert "correct the transform of rear" in problem
    _, report = checked(tmp_path / "fleet.toml", log, capsys=capsys)
    assert problem in report["advice"]


def test_a_radar_that_no_sign_fits_is_named(tmp_path, capsys):
    car = CAR | {"rear": replace(REAR, noise_mps=20.0)}
    values, summary = proposed(logged(tmp_path, car, frames=40), capsys)
    assert signs(values) == {"front": "receding", "corner": "receding", "rear": None}
    assert summary["to_enter"] == ["rear: the Doppler's sign"]
    (problem,) = summary["problems"]
    assert problem.startswith("rear: most scans fit no static world: check doppler_field")


def test_tracks_need_no_sign_and_their_transform_is_what_can_be_wrong(tmp_path, capsys):
    tracking = {name: replace(radar, is_tracking=True) for name, radar in CAR.items()}
    values, summary = proposed(logged(tmp_path / "right", tracking, frames=40), capsys)
    assert set(signs(values).values()) == {None}
    assert (summary["to_enter"], summary["problems"]) == ([], [])
    turned = tracking | {"rear": replace(tracking["rear"], told_yaw_deg=0.0)}
    log = logged(tmp_path / "turned", turned, frames=40)
    _, summary = proposed(log, capsys)
    (problem,) = summary["problems"]
    assert problem.startswith("rear: the car would drive backwards: velocities of tracks")
    _, report = checked(tmp_path / "turned" / "fleet.toml", log, capsys=capsys)
    assert problem.removeprefix("rear: ") in reasons(report, "rear-base")


@pytest.mark.real_logs
def test_a_van_with_a_corner_radar_gets_one_sign_and_another_at_the_corner_is_named(
    van_logs, tmp_path, capsys
):
    logs = sorted(van_logs.glob("*.mcap"))
    fleet = tmp_path / "fleet.toml"
    assert main(["init", *map(str, logs), "--out", str(fleet)]) == 0
    capsys.readouterr()
    given = signs(tomllib.loads(fleet.read_text()))
    assert given == {"radar_front": "receding", "radar_corner_fl": "receding"}
    with_sign(fleet, "radar_corner_fl", "approaching")
    _, report = checked(fleet, *logs, capsys=capsys)
    named = 'doppler_positive of radar_corner_fl is probably "receding"'
    pairs = {v["pair"] for v in report["verdicts"]}
    of_corner = {pair for pair in pairs if "radar_corner_fl" in pair}
    assert {pair for pair in pairs if named in reasons(report, pair)} == of_corner
    refused = {v["pair"] for v in report["verdicts"] if v["verdict"] == "no"}
    assert refused == of_corner
