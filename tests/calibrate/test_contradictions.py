"""Through the whole stage: what sensors contradict is not accepted; pairs adjusted together and judged again."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pipeline.calibrate.records import Inputs
from pipeline.core.config import FleetConfig
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_se3, exp_so3, from_rotation_translation, log_se3
from pipeline.rig.targets import errors_at_targets
from pipeline.store.current import transform_of
from pipeline.store.partitions import Partition
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.makers.calibrated_days import records_of_rows
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR, make_day

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)


def records_of(day, prior=PRIOR, method="joint", solver=None, **sections):
    fleet = FleetConfig.model_validate(
        {"fleet": {"name": "f"}, "rigs": {"default": THREE_SENSORS}, "vehicles": {"v": {}}} | sections
    )
    about = Inputs(Partition("v", "2024-05-06"), method, "k", 1, ())
    return {r.pair: r for r in records_of_rows(day, prior, fleet, about, solver=solver)}


@pytest.fixture(scope="module")
def street():
    return street_day(48, seed=3)


def with_turned_statics(day, yaw_deg):
    """What stands turns about the radar, what moves does not: the lidar's registration against the camera's boxes."""
    R = exp_so3(np.array([0, 0, np.radians(yaw_deg)]))
    out = []
    for o in day:
        xyz = o.radar_xyz_m.astype(np.float64)
        standing = o.radar_motion == 0
        xyz[standing] = xyz[standing] @ R.T
        out.append(
            replace(o, radar_xyz_m=xyz.astype(np.float32), radar_velocity_mps=R @ o.radar_velocity_mps)
        )
    return out


def with_one_scan_repeated(day, k):
    """Every frame has the radar columns of frame k, under the stamps of its own."""
    of_radar = [
        f.name for f in fields(Observation) if f.name.startswith("radar_") and f.name != "radar_stamp_ns"
    ]
    stuck = {name: getattr(day[k], name) for name in of_radar}
    return [replace(o, **stuck) for o in day]


@pytest.mark.slow
def test_a_radar_that_repeats_one_scan_certifies_nothing_however_sure_held_out_frames_are():
    turn = exp_so3(np.array([0, 0, np.radians(0.3)]))
    turned = from_rotation_translation(turn @ T_LIDAR_RADAR[:3, :3], T_LIDAR_RADAR[:3, 3])
    day = with_one_scan_repeated(street_day(48, seed=12), 5)
    record = records_of(day, replace(PRIOR, T_lidar_radar=turned))["lidar_radar"]
    assert errors_at_targets("lidar_radar", transform_of(record), T_LIDAR_RADAR)[0] > np.radians(0.8)
    # The frames that took no part in the fit see the same scan, so they agree with it to a tenth of a degree.
    assert record.diagnostics["holdout_azimuth_remaining_sigma_rad"] < np.radians(0.15)
    assert record.azimuth_sigma_rad > np.radians(0.4)
    assert (record.status, record.determined) == ("held", [])


@pytest.mark.slow
def test_a_registration_that_the_camera_contradicts_is_not_accepted(street):
    records = records_of(street)
    fine = records["lidar_radar"]
    assert "contradict" not in fine.reason
    assert fine.status == "accepted"
    assert fine.determined == ["azimuth"]
    assert any("intrinsics as logged" in a and "0.1 %" in a for a in records["camera_radar"].assumptions)
    assert not any("intrinsics" in a for a in fine.assumptions)
    assert records["camera_lidar"].loop_rotation_sigma_rad > 0
    turned = records_of(with_turned_statics(street, 3.0))
    for pair in ("lidar_radar", "camera_radar"):
        assert turned[pair].status == "held"
        assert "contradict" in turned[pair].reason
        assert turned[pair].faults == ["witnesses_disagree"]
        assert turned[pair].score < 0
        assert turned[pair].determined == []


def test_frames_that_ingest_was_told_to_pair_are_not_thrown_away_by_another_gate():
    late = [replace(o, camera_stamp_ns=o.camera_stamp_ns + 8_000_000) for o in make_day(24)]

    def nothing_found(frames, prior, *_, **__):
        kept = {p: PairEstimate.at_prior(p, prior) for p in frames}
        return Solution("joint", {p: replace(e, frames_used=len(frames[p])) for p, e in kept.items()})

    gated = records_of(late, solver=nothing_found, ingest={"sync_gate_s": 0.005})
    paper = records_of(late, method="pairwise-optimisation", solver=nothing_found)  # keeps the paper's gate
    for found in (gated, paper):
        assert all("sync 24" in found[p].reason for p in ("camera_lidar", "camera_radar"))
        assert found["lidar_radar"].frames_used >= 12
    for ingest in ({}, {"sync_gate_s": 0.02}):
        found = records_of(late, solver=nothing_found, ingest=ingest)
        assert all("sync" not in r.frames_rejected for r in found.values())
        assert found["camera_lidar"].frames_used >= 12


def test_a_composed_pair_that_is_asked_for_brings_its_factors_with_it(street):
    """The camera-radar trigger alone fires; held for want of factors, its record could never be accepted."""
    quiet = {"lidar_outside_fraction": 1.0, "radar_outside_lidar": 99, "drivable_outside_fraction": 1.0}
    found = records_of(street, trigger=quiet | {"when": "triggered", "radar_outside_image": 0.0})
    assert [p for p in PAIRS if found[p].triggered] == ["camera_radar"]
    assert not any("not triggered" in r.reason for r in found.values())
    assert found["lidar_radar"].status == "accepted"


SIGMA_DEG = {"camera_lidar": 0.04, "camera_radar": 0.25, "lidar_radar": 0.04}


def estimates(yaw_deg=None, roll_deg=None, sharp=False):
    """Each pair at the truth but for turns; positions better than the prior in the lidar's pairs alone.

    With `sharp`, camera-radar is as good as they are.
    """
    found = {}
    for pair in PAIRS:
        axis = 2 if pair == "lidar_radar" else 1
        turn = np.zeros(6)
        turn[axis] = np.radians((yaw_deg or {}).get(pair, 0.0))
        turn[2 - axis if axis == 2 else 2] += np.radians((roll_deg or {}).get(pair, 0.0))
        is_weak = pair == "camera_radar" and not sharp
        sigma = np.radians(SIGMA_DEG[pair] if is_weak else 0.04)
        known = np.array([True] * 3 + [not is_weak] * 3)
        shift = np.diag(PRIOR.covariance(pair))[3:] if is_weak else np.full(3, 0.01**2)
        found[pair] = PairEstimate(
            pair, exp_se3(turn) @ PRIOR.of(pair), np.diag([*[sigma**2] * 3, *shift]), known * 0.99, known, 40
        )
    return found


@pytest.fixture(scope="module")
def day():
    return make_day(48)


def records(day, failed=None, **changes):
    solution = Solution("joint", estimates(**changes), failed_checks=failed or {})
    return records_of(day, PRIOR, solver=lambda *_, **__: solution)


def error_deg(record):
    off = log_se3(transform_of(record) @ np.linalg.inv(PRIOR.of(record.pair)))
    return np.degrees(np.abs(off[:3]).max())


def test_camera_and_radar_that_hardly_know_their_pose_are_certified_by_the_other_two(day):
    found = records(day, yaw_deg={"camera_radar": 0.3})
    assert found["camera_radar"].status == "accepted", found["camera_radar"].reason
    assert error_deg(found["camera_radar"]) < 0.03  # of .3, what .25 deg weigh beside .057
    assert np.degrees(found["camera_radar"].azimuth_sigma_rad) < 0.1
    product = transform_of(found["camera_lidar"]) @ transform_of(found["lidar_radar"])
    assert np.allclose(transform_of(found["camera_radar"]), product, atol=1e-9)


def test_an_edge_that_failed_a_check_keeps_its_pose_and_turns_no_other(day):
    lost = {"camera_lidar": [Check("lost at sea", disproves=True)]}
    found = records(day, lost, yaw_deg={"camera_lidar": 1.0})
    assert found["camera_lidar"].status == "held"
    assert found["camera_lidar"].reason.startswith("lost at sea")
    assert error_deg(found["camera_lidar"]) == pytest.approx(1.0)
    assert found["lidar_radar"].status == "accepted"
    assert error_deg(found["lidar_radar"]) < 1e-3
    # By itself camera-radar is good to a quarter of a degree, and that is not enough.
    assert found["camera_radar"].status == "held"
    assert error_deg(found["camera_radar"]) < 0.01


def test_what_the_rest_contradicts_is_held_and_a_camera_that_its_own_frames_confirm_is_not(day):
    found = records(day, yaw_deg={"camera_radar": 2.5})
    for pair in ("lidar_radar", "camera_radar"):
        assert found[pair].status == "held"
        assert "contradict each other" in found[pair].reason
        assert "witnesses_disagree" in found[pair].faults
    assert found["camera_lidar"].status == "accepted"


def test_a_contradiction_frees_no_azimuth_that_it_does_not_know_itself(day):
    """Camera-radar shows a roll. Of azimuth it shows .1 deg at a sigma of .3: the record may be off by more."""
    found = records(day, roll_deg={"camera_radar": 1.5}, yaw_deg={"camera_radar": 0.1})["lidar_radar"]
    assert (found.status, found.faults) == ("held", ["witnesses_disagree"])
    assert "contradict each other" in found.reason
    assert found.reason.endswith("not within the limit")  # and of no size: none is known to less than itself


def test_a_contradiction_in_roll_that_knows_the_azimuth_costs_the_elevation_alone_and_is_named(day):
    found = records(day, roll_deg={"camera_radar": 0.8}, sharp=True)
    for pair in ("lidar_radar", "camera_radar"):
        assert (found[pair].status, found[pair].determined) == ("accepted", ["azimuth"]), found[pair].reason
        assert "contradict each other" in found[pair].reason
        assert "elevation not certified" in found[pair].reason
        assert found[pair].faults == ["witnesses_disagree"]
    turned = records(day, yaw_deg={"camera_radar": 0.4}, sharp=True)
    assert turned["lidar_radar"].status == turned["camera_radar"].status == "held"


def test_a_tilt_in_doubt_is_in_the_covariance_so_that_nobody_takes_it_for_sure(day):
    def sigma_deg(**failed):
        record = records(day, failed, roll_deg={}, sharp=True)["lidar_radar"]
        assert record.status == "accepted"
        by_axis, common = (
            np.diag(np.reshape(m, (6, 6)))[:3] for m in (record.covariance, record.common_covariance)
        )
        return record.determined, np.degrees(np.sqrt(by_axis)), np.degrees(np.sqrt(common))

    determined, sure, _ = sigma_deg()
    assert determined == ["azimuth", "elevation"]
    pitch = Check("the other half says", error=(0.0, np.radians(1.5), 0.0, 0.0, 0.0, 0.0))
    determined, doubted, common = sigma_deg(lidar_radar=[pitch])
    assert determined == ["azimuth"]
    assert doubted[1] > 1.0 > 10 * sure[1]
    assert common[1] > 1.0  # the next day may err alike
    assert doubted[2] == pytest.approx(sure[2], abs=0.02)  # of yaw nobody doubts anything


def test_a_held_edge_that_is_not_known_to_be_wrong_still_contradicts(day):
    held = {"camera_lidar": [Check("another CameraInfo")]}
    found = records(day, held, roll_deg={"camera_radar": 1.5})
    assert "camera-lidar and the other edges contradict" in found["lidar_radar"].reason
    agreeing = records(day, held)["lidar_radar"]
    assert (agreeing.status, agreeing.determined) == ("accepted", ["azimuth", "elevation"])


def test_a_method_of_three_sensors_keeps_the_pairs_as_it_has_them(day):
    solution = Solution("tracking", estimates(yaw_deg={"camera_radar": 0.3}))
    found = records_of(day, PRIOR, "tracking", solver=lambda *_, **__: solution)
    assert error_deg(found["camera_radar"]) == pytest.approx(0.3)
