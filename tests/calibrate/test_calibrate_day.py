"""The stage: observations in a lake to records, refused days included, the same work never twice."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.records import environment_of
from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError
from pipeline.rig.se3 import change_between, from_quaternion
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_observations
from tests.makers.solve_scenes import PRIORS, T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day
from tests.makers.stages import calibrate_day

DAY = Partition("car 1", "2024-05-06")


def fleet_of(prior=None, camera=None, **sections):
    rig = THREE_SENSORS | ({"prior": prior} if prior else {})
    rig = rig | {"camera": THREE_SENSORS["camera"] | (camera or {})}
    small = {"paper_population": 20, "paper_generations": 10, "search_rotation_deg": 4.0}
    sections["solve"] = small | sections.get("solve", {})
    known = {
        "fleet": {"name": "f"}, "rigs": {"default": rig}, "vehicles": {"car 1": {}}, "select": {"frames": 16},
    }  # fmt: skip
    return FleetConfig.model_validate(known | sections)


def lake_with(tmp_path, observations, key="k1"):
    lake = Lake.at(tmp_path)
    write_observations(lake, DAY, observations, key)
    return lake


def records_of(lake):
    return read_records(lake, CALIBRATIONS, CalibrationRecord)


@pytest.fixture(scope="module")
def day():
    return make_day(40)


@pytest.fixture(scope="module")
def solved(day, tmp_path_factory):
    lake = lake_with(tmp_path_factory.mktemp("lake"), day)
    result = calibrate_day(DAY, fleet_of(), lake, method="pairwise-optimisation", perturb=(2.0, 0.1), seed=5)
    return lake, result


def test_one_record_per_pair_with_every_column_filled(solved):
    lake, result = solved
    records = {r.pair: r for r in records_of(lake)}
    assert set(records) == set(PAIRS)
    assert result.status == "done"
    assert result.kept["accepted"] + result.kept["held"] == 3
    for record in records.values():
        assert record.status in ("accepted", "held")
        assert record.frames_total == 40
        assert record.frames_used == 16
        assert sum(record.frames_rejected.values()) == 24
        assert record.environment == "urban"
        assert record.seed == 5
        assert record.inputs == ["k1"]
        assert record.covariance.shape == (6, 6)
        assert np.all(np.linalg.eigvalsh(record.covariance) > 0)
        assert record.alignment_before != record.alignment_after
        assert record.trigger_before
        assert set(record.trigger_before) == set(record.trigger_after)
        assert record.diagnostics["holdout_frames"] >= 3


def test_the_perturbed_prior_is_off_by_exactly_what_was_asked(solved):
    lake, _ = solved
    for record in (r for r in records_of(lake) if r.pair in PRIORS):
        q = np.array([record.prior_qw, record.prior_qx, record.prior_qy, record.prior_qz])
        T = from_quaternion(q, np.array([record.prior_tx_m, record.prior_ty_m, record.prior_tz_m]))
        change = change_between(PRIORS[record.pair], T)
        assert np.degrees(np.linalg.norm(change[:3])) == pytest.approx(2.0, abs=1e-6)
        assert np.linalg.norm(change[3:]) == pytest.approx(0.1, abs=1e-9)
        # The larger of 0.05 as configured and the perturbation.
        assert np.sqrt(record.prior_covariance[3, 3]) == pytest.approx(0.1)


def test_the_same_work_is_done_once(solved):
    lake, first = solved
    before = len(records_of(lake))
    again = calibrate_day(DAY, fleet_of(), lake, method="pairwise-optimisation", perturb=(2.0, 0.1), seed=5)
    assert again.status == "cached"
    assert again.work_key == first.work_key
    assert again.kept == first.kept
    assert len(records_of(lake)) == before


def test_other_seed_method_perturbation_or_config_is_other_work(tmp_path):
    lake = Lake.at(tmp_path)
    ways = [
        (fleet_of(), {"method": "joint", "seed": 5}),
        (fleet_of(), {"method": "joint", "seed": 6}),
        (fleet_of(), {"method": "pairwise-optimisation", "seed": 5}),
        (fleet_of(), {"method": "joint", "seed": 5, "perturb": (2.0, 0.1)}),
        (fleet_of(solve={"paper_generations": 11}), {"method": "joint", "seed": 5}),
        (fleet_of(trigger={"when": "triggered"}), {"method": "joint", "seed": 5}),
        (fleet_of(camera={"readout_s": 0.03}), {"method": "joint", "seed": 5}),
    ]
    keys = {calibrate_day(DAY, fleet, lake, **way).work_key for fleet, way in ways}
    assert len(keys) == len(ways)
    assert len(records_of(lake)) == 3 * len(ways)
    audit = fleet_of(audit={"baseline_days": 5})
    assert calibrate_day(DAY, audit, lake, method="joint", seed=5).status == "cached"  # no part of this stage


def with_prior(day, prior, since=0):
    return [replace(o, priors=prior) if i >= since else o for i, o in enumerate(day)]


MOVED = T_CAMERA_LIDAR + np.array([[0, 0, 0, 0.01], *[[0] * 4] * 3])
LIDAR_ALONE = {"camera_lidar": T_CAMERA_LIDAR}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (None, "no observations"),
        (lambda day: day[:5], "too few frames"),
        (lambda _: [], "no prior"),
        (lambda day: with_prior(day, day[0].priors | {"camera_lidar": MOVED}, 21), "changes over the day"),
        (lambda day: with_prior(day, {}), "no tf_static chain for any pair"),
    ],
)
def test_a_day_without_enough_frames_or_one_prior_is_refused_with_the_reason(tmp_path, day, changed, words):
    lake = lake_with(tmp_path, changed(day)) if changed else Lake.at(tmp_path)
    result = calibrate_day(DAY, fleet_of(), lake, method="pairwise-optimisation")
    assert (result.status, result.kept) == ("refused", {"accepted": 0, "held": 0, "refused": 3})
    for record in records_of(lake):
        assert (record.status, record.qw) == ("refused", None)
        assert words in record.reason


def test_a_pair_without_a_prior_is_refused_alone_and_frames_without_one_are_not(tmp_path, day):
    lake = lake_with(tmp_path / "a", with_prior(day, LIDAR_ALONE))
    calibrate_day(DAY, fleet_of(), lake, method="pairwise-optimisation")
    records = {r.pair: r for r in records_of(lake)}
    assert records["camera_lidar"].status in ("accepted", "held")
    for pair in ("camera_radar", "lidar_radar"):
        assert f"no tf_static chain for {pair}" in records[pair].reason
    lake = lake_with(tmp_path / "b", [*with_prior(day[:3], LIDAR_ALONE), *day[3:]])
    assert calibrate_day(DAY, fleet_of(), lake, method="pairwise-optimisation").status == "done"


def test_a_prior_file_is_read_beside_fleet_toml_and_its_content_is_part_of_the_work(tmp_path, day):
    fleet = fleet_of(prior={"source": "file", "file": "prior.json"})
    lake = lake_with(tmp_path, [replace(o, priors={"lidar_radar": T_LIDAR_RADAR}) for o in day])
    content = '{"T_camera_lidar": %s, "T_lidar_radar": %s}'
    path = tmp_path / "prior.json"
    path.write_text(content % (T_CAMERA_LIDAR.tolist(), T_LIDAR_RADAR.tolist()))
    fleet = fleet.read_from(tmp_path / "fleet.toml")
    first = calibrate_day(DAY, fleet, lake, method="pairwise-optimisation")
    assert first.status == "done"
    path.write_text(content % (T_CAMERA_LIDAR.tolist(), np.eye(4).tolist()))
    again = calibrate_day(DAY, fleet, lake, method="pairwise-optimisation")
    assert again.work_key != first.work_key
    path.write_text('{"T_camera_lidar": [[1, 0], [0, 1]]}')
    with pytest.raises(ConfigError, match="T_camera_lidar: is no 4x4"):
        calibrate_day(DAY, fleet, lake, method="pairwise-optimisation")


def test_without_a_trigger_the_prior_stays(tmp_path, day):
    quiet = {"when": "triggered", "lidar_outside_fraction": 1.0, "radar_outside_image": 99,
             "radar_outside_lidar": 99, "drivable_outside_fraction": 1.0}  # fmt: skip
    lake = lake_with(tmp_path, day)
    result = calibrate_day(DAY, fleet_of(trigger=quiet), lake, method="joint-optimisation")
    assert result.kept == {"accepted": 0, "held": 3, "refused": 0}
    for record in records_of(lake):
        assert record.trigger_before
        assert record.reason == "not triggered: the prior stays"
        assert record.triggered is False
        assert record.tx_m == record.prior_tx_m


def test_the_verdicts_thresholds_are_those_of_the_configuration(tmp_path, day):
    lake = lake_with(tmp_path, day)
    strict = fleet_of(verify={"checks": {"max_move_prior_sigmas": 1e-6}})
    result = calibrate_day(DAY, strict, lake, method="pairwise-optimisation")
    assert result.kept["accepted"] == 0
    records = [r for r in result.records if isinstance(r, CalibrationRecord)]
    assert all("sigmas of the prior" in r.reason for r in records)


@pytest.mark.parametrize(
    ("speeds", "environment"),
    [
        ([30.0] * 10, "highway"), ([8.0] * 10, "urban"), ([8.0] * 5 + [30.0] * 5, "mixed"),
        ([None] * 10, "unknown"), ([0.0] * 10, "unknown"),
    ],
)  # fmt: skip
def test_environment_follows_from_speed(day, speeds, environment):
    assert environment_of([replace(day[0], ego_speed_mps=s) for s in speeds]) == environment


def test_unknown_methods_are_a_usage_error_before_anything_is_read(tmp_path):
    nothing = Lake.at(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="magic") as caught:
        calibrate_day(DAY, fleet_of(), nothing, method="magic")
    assert caught.value.exit_code == 2
    assert not nothing.root.exists()
    with pytest.raises(ConfigError, match="magic"):
        fleet_of(audit={"method": "joint"}).changed(audit={"method": "magic"})
    with pytest.raises(ConfigError, match="unknown vehicle"):
        calibrate_day(Partition("other", DAY.day), fleet_of(), nothing, method="joint-optimisation")
