"""Known turns turn what they say, over a set in all directions; rates and claims count what they say."""

import hashlib
from collections import Counter

import numpy as np
import pytest

from pipeline.config import VerifyConfig
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, to_quaternion
from pipeline.verify.axes import check_pose, limits_of
from pipeline.verify.claims import judged_claims
from pipeline.verify.one_axis import AxisCheck
from pipeline.verify.rates import by_sensor, by_turn, looks_of
from pipeline.verify.shared_errors import reads_of
from pipeline.verify.turns import Turn, turns_of_log
from schemas.poses import PoseRow
from schemas.set_checks import SetCheck

T_LIDAR_CAMERA = from_rotation_translation(exp_so3(np.array([-1.2, 1.2, -1.2])), np.array([0.3, 0.1, -0.2]))
T_LIDAR_RADAR = from_rotation_translation(exp_so3(np.array([0.02, -0.03, 0.1])), np.array([2.0, 0.1, -1.0]))
SENSORS = {"camera": ("camera_lidar", T_LIDAR_CAMERA), "radar": ("lidar_radar", T_LIDAR_RADAR)}


@pytest.mark.parametrize(
    ("sensor", "axis"),
    [
        ("camera", "azimuth"),
        ("camera", "elevation"),
        ("camera", "roll"),
        ("radar", "azimuth"),
        ("radar", "elevation"),
    ],
)
def test_a_turn_moves_its_own_axis_by_its_size_and_hardly_the_others(sensor, axis):
    kind, T = SENSORS[sensor]
    limits = limits_of(kind, VerifyConfig(), (0.5, 1.0))
    quaternion = dict(zip(("qw", "qx", "qy", "qz"), to_quaternion(T).tolist(), strict=True))
    origin = dict(zip(("tx_m", "ty_m", "tz_m"), T[:3, 3].tolist(), strict=True))
    row = PoseRow(
        vehicle="v", day="2026-03-02", method="joint", sensor=sensor, kind=sensor, reference="lidar",
        status="accepted", reason="", code_version="", covariance=1e-8 * np.eye(6),
        targets_m=np.array([[15.0, 0, 0], [25, 2, 0], [40, -3, 1]]), **quaternion, **origin,
    )  # fmt: skip
    turned = T @ Turn(sensor, kind, axis, -0.7).transform()
    off = {c.axis: np.degrees(c.off_rad) for c in check_pose(row, turned, limits, 3.0)}
    assert off.pop(axis) == pytest.approx(0.7, abs=0.03)
    assert all(value < 0.2 for value in off.values())


def test_turns_go_over_all_sensors_axes_and_sizes_of_a_set_both_signs_in_one_log():
    checks = [
        AxisCheck(s, kind, axis, "pass", "", 0.0, 0.0, 0.003, float(np.radians(asked)), 1.0, 0.0)
        for s, kind, asked, axes in (
            ("camera", "camera_lidar", 0.5, ("azimuth", "elevation", "roll")),
            ("radar", "lidar_radar", 1.0, ("azimuth", "elevation")),
        )
        for axis in axes
    ]
    seen = Counter()
    for log in range(400):
        turns = turns_of_log(checks, (0.5, 1.0, 2.0), 4, hashlib.sha256(str(log).encode()).hexdigest())
        assert turns == turns_of_log(
            checks[::-1], (0.5, 1.0, 2.0), 4, hashlib.sha256(str(log).encode()).hexdigest()
        )
        assert sum(t.deg for t in turns) == 0
        seen.update(t.name for t in turns)
    assert len(seen) == 30
    assert min(seen.values()) > 20
    assert "radar elevation -2" in seen


def row(log, answer, *, turn=0.0, status="pass", sensor="camera"):
    about = {
        "turn": f"camera azimuth {turn:+g}",
        "turn_sensor": "camera",
        "turn_axis": "azimuth",
        "turn_deg": turn,
    }
    return SetCheck(
        vehicle="v", day="2026-03-02", log=log, rig="r", shipped="s", sensor=sensor, kind="camera_lidar",
        axis="azimuth", answer=answer, status=status, off_rad=0.001, sigma_rad=0.001, limit_rad=0.003,
        asked_rad=0.01, power=0.9, shown_rad=0.005, beyond=3.0, **(about if turn else {}),
    )  # fmt: skip


LOOKS = looks_of(
    [
        row("a", "right"), row("a", "wrong", turn=0.5), row("a", "right", turn=-0.5, status="inconclusive"),
        row("a", "right", sensor="radar"), row("a", "wrong", turn=0.5, sensor="radar"),
        row("b", "wrong"), row("b", "right", turn=0.5),
        row("c", "undecided"), row("c", "undecided", turn=-0.5),
    ]
)  # fmt: skip


def test_a_turn_of_what_is_called_wrong_as_shipped_is_left_out_and_a_blamed_neighbour_is_counted():
    [camera] = by_turn(LOOKS)
    counts = ("looks", "wrong", "right", "undecided", "axis_open", "left_out", "blamed")
    assert {name: camera[name] for name in counts} == dict(zip(counts, (3, 1, 1, 1, 1, 1, 1), strict=True))
    assert (camera["plus"]["looks"], camera["plus"]["wrong"], camera["minus"]["looks"]) == (1, 1, 2)
    assert camera["stated"] == pytest.approx(0.9999, abs=1e-2)
    own = {s["sensor"]: (s["looks"], s["right"], s["wrong"], s["undecided"]) for s in by_sensor(LOOKS)}
    assert own == {"camera": (3, 1, 1, 1), "radar": (1, 1, 0, 0)}


def test_a_claim_is_judged_by_the_looks_that_it_names():
    text = """
[[claims]]
text = "caught"
answer = "caught"
sensor = "camera"
deg = 0.5
at_least = 0.3
[[claims]]
text = "never wrong"
answer = "wrong"
sensor = "camera"
at_most = 0.0
[[claims]]
text = "another size"
answer = "missed"
deg = 2.0
at_most = 0.0
"""
    file = {
        "path": "/nowhere/claims.toml",
        "sha256": "",
        "registered_at": "",
        "asked_before": 0,
        "text": text,
    }
    found = judged_claims([file], LOOKS)
    assert [(c["verdict"], c["hits"], c["trials"]) for c in found] == [
        ("holds", 1, 3), ("refuted", 1, 3), ("not tested", 0, 0),
    ]  # fmt: skip
    assert judged_claims([file | {"asked_before": 3}], LOOKS)[1]["as_registered"] == "refuted"


def test_an_answer_names_what_it_was_computed_from():
    kinds = {"front": "camera", "top": "lidar", "bumper": "radar"}
    assert reads_of("camera_lidar", ["front-top"], kinds)[:2] == ["camera labels", "CameraInfo"]
    assert "camera labels" not in reads_of("lidar_radar", ["top-bumper"], kinds)
    assert "CameraInfo" in reads_of("lidar_radar", ["top-bumper", "front-bumper"], kinds)
