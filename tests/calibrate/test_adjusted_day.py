"""Pairs estimated apart, adjusted together and judged again: what each record says then."""

import numpy as np
import pytest

from pipeline.rig.checks import Check
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_se3, log_se3
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.metrics import transform_of
from tests.calibrate.test_contradictions import records_of
from tests.makers.radar_scenes import T_LIDAR_RADAR
from tests.makers.solve_scenes import T_CAMERA_LIDAR, make_day

PRIOR = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.05)
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


@pytest.mark.parametrize("yaw_deg", [0.0, 0.1])
def test_a_contradiction_frees_no_azimuth_that_it_does_not_know_itself(day, yaw_deg):
    """Camera-radar shows a roll. Of azimuth it shows .1 deg at a sigma of .3: the record may be off by more."""
    found = records(day, roll_deg={"camera_radar": 1.5}, yaw_deg={"camera_radar": yaw_deg})["lidar_radar"]
    assert (found.status, found.faults) == ("held", ["witnesses_disagree"])
    assert "contradict each other" in found.reason
    assert "deg at the targets, not within the limit" in found.reason


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
