"""What the study of whole rigs calls an error: a turned sensor is off by its turn, in its own azimuth or elevation."""

import numpy as np
import pytest

from pipeline.geometry.se3 import exp_se3, inverse, to_quaternion
from schemas.poses import PoseRow
from tests.benchmarks.studies.rig_days import row_of, true_poses

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def pose(kind, T, **told):
    q, t = to_quaternion(T), T[:3, 3]
    return PoseRow(
        vehicle="v", day="2026-03-02", method="joint", sensor="s", kind=kind, reference="top", status="accepted",
        reason="", code_version="t", work_key="w", qw=q[0], qx=q[1], qy=q[2], qz=q[3], tx_m=t[0], ty_m=t[1], tz_m=t[2],
        covariance=np.eye(6) * 1e-4, azimuth_sigma_rad=0.01, elevation_sigma_rad=0.01, **told,
    )  # fmt: skip


@pytest.mark.parametrize(("kind", "azimuth_axis", "elevation_axis"), [("radar", 2, 1), ("camera", 1, 0)])
def test_a_sensor_that_is_turned_in_its_own_axes_is_off_by_as_much(kind, azimuth_axis, elevation_axis):
    top = exp_se3(np.array([0.02, -0.01, 0.3, 1.0, 0.2, 1.9]))
    own = exp_se3(np.array([0.0, 0.1, 1.2, 0.5, 0.9, 0.6]))
    if kind == "camera":
        own[:3, :3] = own[:3, :3] @ OPTICAL
    truth = {"top": top, "s": own}
    exact = row_of(pose(kind, inverse(top) @ own), truth)
    assert (exact["az_deg"], exact["el_deg"]) == pytest.approx((0, 0), abs=1e-3)
    for axis, wrong, right in ((azimuth_axis, "az_deg", "el_deg"), (elevation_axis, "el_deg", "az_deg")):
        turn = exp_se3(np.radians(0.5) * (np.arange(6) == axis))
        row = row_of(pose(kind, inverse(top) @ own @ turn), truth)
        assert row[wrong] == pytest.approx(0.5, abs=0.02)
        assert row[right] < 0.1
        assert row["chi2_per_dof"] > 0.05


def test_a_sensor_that_was_not_computed_has_no_numbers():
    refused = PoseRow(
        vehicle="v", day="2026-03-02", method="joint", sensor="s", kind="radar", reference="top", status="refused",
        reason="shares nothing", code_version="t", work_key="w",
    )  # fmt: skip
    assert "az_deg" not in row_of(refused, {"top": np.eye(4), "s": np.eye(4)})


def test_a_radar_is_held_against_where_its_detections_point():
    truth = {
        "at_end_of_day": {"T_base_sensor": {"r": np.eye(4).tolist()}},
        "radars": {"r": {"elevation_bias_rad": 0.01}},
    }
    # What lies straight ahead of it is detected .01 rad above: in the detections' axes ahead is below.
    ahead = true_poses(truth)["r"] @ np.array([np.cos(0.01), 0.0, np.sin(0.01), 1.0])
    np.testing.assert_allclose(ahead[:3], [1.0, 0.0, 0.0], atol=1e-9)
