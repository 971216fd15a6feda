"""Edges to the vehicle frame through all stages: what is far from its prior or turned round is named, and not used."""

import json

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.rig.se3 import change_between, exp_so3, from_rotation_translation, inverse
from pipeline.simulate.fleet import FleetSpec
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow
from tests.end_to_end.test_rig_day import DAY, MOMENTS
from tests.makers.kept_days import kept_fleet
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

pytestmark = pytest.mark.slow
RADARS, ALL = ("nose", "corner_fl"), ("top", "nose", "corner_fl")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Logs of a day, and T_base_sensor of all sensors."""
    out = tmp_path_factory.mktemp("car")
    kept_fleet(
        FleetSpec(vehicles=1, days=1, frames=MOMENTS, drives=2, rig="duo", environments="mixed", seed=31), out
    )
    truth = json.loads((out / "truth" / DAY.vehicle / f"{DAY.day}.json").read_text())
    return out, {name: np.array(T) for name, T in truth["T_base_sensor"].items()} | {"base": np.eye(4)}


def calibrated(made, folder, sensors, *, turned=(), off=None):
    """Records by edge and poses by sensor of a rig of some sensors, read with the Doppler of some turned.

    `off` has turns [deg] and shifts [m] of the prior of sensors, in axes of the base; else it is logged.
    """
    out, truth = made
    fleet = load_fleet(out / "fleet.toml")
    rig = fleet.rigs["duo"]
    radars, lidars = dict(rig.radars), {name: of for name, of in rig.lidars.items() if name in sensors}
    for name in turned:
        other = {"receding": "approaching", "approaching": "receding"}[radars[name].doppler_positive]
        radars[name] = radars[name].model_copy(update={"doppler_positive": other})
    changes = {"cameras": {}, "lidars": lidars, "radars": radars, "reference": sensors[0]}
    if off is not None:
        path = folder / "prior.json"
        path.write_text(json.dumps(prior_file(truth, sensors, off)))
        changes["prior"] = rig.prior.model_copy(update={"source": "file", "file": str(path)})
    fleet = fleet.model_copy(update={"rigs": {"duo": rig.model_copy(update=changes)}})
    lake = Lake.at(folder / "lake")
    ingest_day(sorted((out / "logs" / DAY.vehicle / DAY.day).iterdir()), DAY, fleet, lake)
    perceive_day(DAY, fleet, lake)
    rows = calibrate_day(DAY, fleet, lake).records
    records = {(r.parent_frame, r.child_frame): r for r in rows if isinstance(r, CalibrationRecord)}
    return records, {r.sensor: r for r in rows if isinstance(r, PoseRow)}


def prior_file(truth, sensors, off):
    reference, T = sensors[0], {}
    for name in (*sensors, "base"):
        rpy_deg, xyz_m = off.get(name, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        R = exp_so3(np.radians(rpy_deg)) @ truth[name][:3, :3]
        T[name] = from_rotation_translation(R, truth[name][:3, 3] + xyz_m)
    told = {name: (inverse(T[reference]) @ T[name]).tolist() for name in T if name != reference}
    return {"reference": reference, "T": told}


def yaw_error_deg(record, truth):
    T = inverse(transform_of(record))
    return abs(np.degrees(change_between(T, truth[record.parent_frame])[2]))


def test_radars_on_the_car_are_accepted_and_used_with_odometry_alone(made, tmp_path):
    records, poses = calibrated(made, tmp_path, RADARS)
    for name in RADARS:
        record = records[name, "base"]
        assert (record.status, record.determined, record.used) == ("accepted", ["azimuth"], True)
        assert yaw_error_deg(record, made[1]) < 0.1
    assert "nose-base" in poses["corner_fl"].edges


def test_a_radar_whose_doppler_has_the_other_sign_is_named_and_nothing_of_it_is_used(made, tmp_path):
    records, poses = calibrated(made, tmp_path, RADARS, turned=("nose",))
    wrong = records["nose", "base"]
    assert (wrong.status, wrong.determined, wrong.faults, wrong.used) == ("held", [], ["doppler"], False)
    assert "doppler_positive" in wrong.reason
    assert not any("nose-base" in pose.edges for pose in poses.values() if pose.edges)
    right = records["corner_fl", "base"]
    assert (right.status, right.used) == ("accepted", True)
    assert yaw_error_deg(right, made[1]) < 0.1
    held = poses["base"]
    assert (held.status, held.faults, held.determined) == ("refused", ["doppler"], [])


def test_a_radar_turned_beyond_the_search_range_is_held_by_its_prior(made, tmp_path):
    records, poses = calibrated(made, tmp_path, RADARS, off={"nose": ((0.0, 0.0, 15.0), (0.0, 0.0, 0.0))})
    record = records["nose", "base"]
    assert (record.status, record.faults, record.used) == ("held", ["prior"], False)
    assert "beyond the search range" in record.reason
    assert not any("nose-base" in pose.edges for pose in poses.values() if pose.edges)
    assert (poses["base"].status, poses["base"].faults) == ("refused", ["prior"])


def test_a_base_whose_prior_is_half_a_metre_and_five_degrees_off_is_held(made, tmp_path):
    off = {"base": ((0.0, 5.0, 0.0), (0.0, 0.0, 0.5))}
    records, poses = calibrated(made, tmp_path, ALL, off=off)
    record = records["top", "base"]
    assert (record.status, record.faults, record.used) == ("held", ["prior"], False)
    assert "m off the prior" in record.reason
    assert "top-base" not in poses["nose"].edges
    assert (poses["base"].determined, poses["base"].status) == ([], "held")
    assert poses["base"].faults == ["prior"]
    assert not poses["base"].unsure_only
    assert records["top", "nose"].status == "accepted", records["top", "nose"].reason
