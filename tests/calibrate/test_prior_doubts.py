"""Edges far from the prior say whose prior is wrong: poses that rest on it are held, others stay."""

from dataclasses import replace

import pytest

from pipeline.calibrate.pose_rows import hold_doubted
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

TOLD = {"vehicle": "v", "day": "2026-03-02", "method": "joint", "work_key": "w", "code_version": "t"}


def pose(sensor):
    about = {"sensor": sensor, "kind": "radar", "reference": "top", "status": "accepted", "reason": ""}
    return PoseRow(**TOLD, **about, determined=["azimuth"])


def against(*names):
    """Records of edges, each far from its prior."""
    held = {"pair": "camera_lidar", "status": "held", "reason": "tx moved", "faults": ["prior"], "seed": 0}
    edges = (name.split("-") for name in names)
    return [CalibrationRecord(**TOLD, **held, parent_frame=a, child_frame=b) for a, b in edges]


@pytest.mark.parametrize(
    ("edges", "held"),
    [
        ((), []),
        (("left-top", "top-nose"), ["left", "nose", "rear"]),  # the reference: every pose is told by it
        (("left-top", "left-nose"), ["left"]),
        (
            ("left-top",),
            ["left"],
        ),  # one edge alone accuses the sensor, for the whole rig stands by the reference
        (("left-top", "top-nose", "left-nose"), ["left", "nose"]),
    ],
)
def test_poses_are_held_that_rest_on_a_prior_which_edges_contradict(edges, held):
    rows, _ = hold_doubted([pose(name) for name in ("top", "left", "nose", "rear")], against(*edges))
    assert [row.sensor for row in rows if row.status == "held"] == held
    for row in rows:
        assert (row.faults, row.determined) == (
            (["prior"], []) if row.status == "held" else ([], ["azimuth"])
        )
        assert row.status != "held" or all(edge in row.reason for edge in edges)


def test_edges_of_a_sensor_with_a_wrong_prior_are_held_unless_they_know_its_place_themselves():
    def accepted(pair, parent, child, knows_place):
        place = [True] * 3 + [knows_place] * 2 + [False]
        own = {
            "status": "accepted",
            "reason": "",
            "faults": [],
            "determined": ["azimuth"],
            "observable": place,
        }
        return replace(against(f"{parent}-{child}")[0], pair=pair, **own)

    edges = [
        accepted("radar_base", "nose", "base", False),
        accepted("lidar_radar", "grille", "nose", True),
        accepted("camera_radar", "left", "rear", False),
    ]
    _, records = hold_doubted([pose("top"), pose("nose")], [*against("top-nose"), *edges])
    found = {f"{r.parent_frame}-{r.child_frame}": (r.status, r.determined) for r in records[1:]}
    assert found == {
        "nose-base": ("held", []),
        "grille-nose": ("accepted", ["azimuth"]),
        "left-rear": ("accepted", ["azimuth"]),
    }


def test_what_was_only_unsure_does_not_count_where_its_prior_is_contradicted():
    unsure = replace(
        pose("left"), status="held", reason="azimuth known to .2 deg", unsure_only=True, determined=[]
    )
    record = replace(
        against("left-nose")[0],
        pair="camera_radar",
        faults=[],
        reason="azimuth",
        diagnostics={"unsure_only": 1.0},
    )
    rows, records = hold_doubted([pose("top"), unsure], [*against("left-top"), record])
    assert (rows[1].status, rows[1].faults, rows[1].unsure_only) == ("held", ["prior"], False)
    assert rows[1].reason.endswith("; azimuth known to .2 deg")
    assert (records[1].faults, records[1].diagnostics["unsure_only"]) == (["prior"], 0.0)
