"""Through the whole stage: what sensors contradict is not accepted, and what no trigger asked for keeps the prior."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pipeline.calibrate.records import Inputs
from pipeline.core.config import FleetConfig
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_so3, from_rotation_translation, perturb_exactly
from pipeline.rig.targets import errors_at_targets
from pipeline.store.partitions import Partition
from schemas.calibrations import PAIRS
from schemas.observations import Observation
from tests.benchmarks.studies.metrics import transform_of
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


def test_pairs_that_no_trigger_asked_for_keep_the_prior_beside_one_that_is_calibrated():
    start = perturb_exactly(T_CAMERA_LIDAR, np.radians(1.0), 0.02, np.random.default_rng(0))
    found = records_of(
        make_day(40),
        replace(PRIOR, T_camera_lidar=start),
        "pairwise-optimisation",
        trigger={
            "when": "triggered",
            "radar_outside_image": 99,
            "radar_outside_lidar": 99,
            "drivable_outside_fraction": 1.0,
        },
        solve={"paper_population": 10, "paper_generations": 5},
        select={"frames": 12},
    )
    assert found["camera_lidar"].triggered
    assert found["camera_lidar"].frames_used == 12
    assert "not triggered" not in found["camera_lidar"].reason
    for pair in ("camera_radar", "lidar_radar"):
        r = found[pair]
        assert (r.status, r.reason, r.triggered) == ("held", "not triggered: the prior stays", False)
        assert (r.tx_m, r.ty_m, r.tz_m) == (r.prior_tx_m, r.prior_ty_m, r.prior_tz_m)
        np.testing.assert_allclose(r.covariance, r.prior_covariance)
        assert not any(r.observable)
        assert r.determined == []


def test_frames_that_ingest_was_told_to_pair_are_not_thrown_away_by_another_gate():
    late = [replace(o, camera_stamp_ns=o.camera_stamp_ns + 8_000_000) for o in make_day(24)]

    def nothing_found(frames, prior, config, *, seed, triggered, progress):
        del config, seed, triggered, progress
        kept = {
            p: PairEstimate(
                p, prior.of(p), prior.covariance(p), np.zeros(6), np.zeros(6, bool), len(frames[p])
            )
            for p in frames
        }
        return Solution("joint", kept)

    gated = records_of(late, solver=nothing_found, ingest={"sync_gate_s": 0.005})
    paper = records_of(late, method="pairwise-optimisation", solver=nothing_found)  # keeps the paper's gate
    for found in (gated, paper):
        assert all("sync 24" in found[p].reason for p in ("camera_lidar", "camera_radar"))
        assert found["lidar_radar"].frames_used >= 12
    for ingest in ({}, {"sync_gate_s": 0.02}):
        found = records_of(late, solver=nothing_found, ingest=ingest)
        assert all("sync" not in r.frames_rejected for r in found.values())
        assert found["camera_lidar"].frames_used >= 12


def test_a_pose_beyond_the_search_range_is_disproved_and_one_that_is_only_unsure_is_not(street):
    def solved(metres):
        T = PRIOR.T_lidar_radar.copy()
        T[0, 3] += metres
        estimates = {
            pair: PairEstimate(
                pair, PRIOR.of(pair), PRIOR.covariance(pair), np.zeros(6), np.zeros(6, bool), 40
            )
            for pair in PAIRS
        }
        estimates["lidar_radar"] = replace(estimates["lidar_radar"], T=T)
        return records_of(street, solver=lambda *_, **__: Solution("joint", estimates))

    assert solved(0.75)["lidar_radar"].diagnostics["disproved"] == 1.0
    assert solved(0.02)["lidar_radar"].diagnostics["disproved"] == 0.0


def test_a_composed_pair_that_is_asked_for_brings_its_factors_with_it(street):
    """The camera-radar trigger alone fires; held for want of factors, its record could never be accepted."""
    found = records_of(
        street,
        trigger={
            "when": "triggered",
            "radar_outside_image": 0.0,
            "lidar_outside_fraction": 1.0,
            "radar_outside_lidar": 99,
            "drivable_outside_fraction": 1.0,
        },
    )
    assert [found[p].triggered for p in ("camera_lidar", "camera_radar", "lidar_radar")] == [
        False,
        True,
        False,
    ]
    assert not any("not triggered" in r.reason for r in found.values())
    assert found["lidar_radar"].status == "accepted"
