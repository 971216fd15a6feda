"""What radars state of their own alignment beside what the day's edges found."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.radar_alignment import with_alignments
from pipeline.calibrate.records import Inputs
from pipeline.extrinsics.radar_turn import turn_of_radar
from pipeline.geometry.changes import change_between
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse, to_quaternion
from pipeline.rig.edges import edge_named
from pipeline.store.partitions import Partition
from pipeline.store.tables import Manifest
from schemas.calibrations import CALIBRATIONS
from schemas.moments import RADAR_ALIGNMENT
from tests.makers.table_rows import make_row

ABOUT = Inputs(Partition("car", "2026-03-02"), "joint", "key", 1, ("ingested",))
CORNER = from_rotation_translation(exp_so3(np.array([0.0, 0.02, np.radians(55)])), np.array([3.5, 0.8, -1.2]))
STATED = {
    "topics": ["/radar/status"], "messages": 9, "without_angle": 1, "statuses": {"0": 9}, "first_stamp_ns": 1,
    "last_stamp_ns": 9, "azimuth_rad": 0.004, "azimuth_sigma_rad": 0.001, "azimuth_scatter_rad": 0.0002,
    "azimuth_step_rad": np.radians(0.3), "step_stamp_ns": 1_700_000_000 * 10**9,
}  # fmt: skip


def turned(azimuth_deg, elevation_deg):
    """A radar's rotation in its own axes: first to the left, then upwards."""
    R = exp_so3(np.radians([0.0, 0.0, azimuth_deg])) @ exp_so3(np.radians([0.0, -elevation_deg, 0.0]))
    return from_rotation_translation(R, np.zeros(3))


@pytest.mark.parametrize("pair", ["lidar_radar", "camera_radar", "radar_base"])
def test_a_turn_of_the_radar_is_its_azimuth_and_elevation_on_every_edge(pair):
    edge = edge_named(pair, "a", "b")
    before, after = CORNER, CORNER @ turned(0.3, -0.2)
    if pair == "radar_base":
        before, after = inverse(before), inverse(after)
    found = turn_of_radar(edge, before) @ change_between(before, after)[:3]
    assert np.degrees(found) == pytest.approx([0.3, -0.2], abs=2e-3)


def record(T_prior, T, **values):
    def pose(T, prefix=""):
        numbers = (*to_quaternion(T), *T[:3, 3])
        return {
            prefix + n: float(v)
            for n, v in zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), numbers, strict=True)
        }

    made = make_row(CALIBRATIONS.name, np.random.default_rng(1), pair="lidar_radar")
    covariance = np.diag(np.radians([0.4, 0.2, 0.1]).tolist() + [0.02] * 3) ** 2
    known = {"parent_frame": "top", "child_frame": "corner", "status": "accepted", "covariance": covariance}
    return replace(made, **pose(T), **pose(T_prior, "prior_"), **known | values)


def rows_of(*records):
    manifest = Manifest("moments", 1, "", "", extra={RADAR_ALIGNMENT: {"corner": STATED}})
    return with_alignments(records, manifest, ABOUT)


def test_a_row_holds_what_the_day_found_about_the_same_axes():
    *_, row = rows_of(record(np.eye(4), turned(0.3, -0.2)))
    assert (row.sensor, row.method, row.own_edge, row.messages) == ("corner", "joint", "top-corner", 9)
    own = (row.own_azimuth_rad, row.own_elevation_rad, row.own_azimuth_sigma_rad, row.own_elevation_sigma_rad)
    assert np.degrees(own) == pytest.approx([0.3, -0.2, 0.1, 0.2], abs=2e-3)


def test_a_refused_day_states_what_the_radar_does_and_nothing_of_its_own():
    *_, row = rows_of(record(np.eye(4), np.eye(4), status="refused"))
    assert (row.azimuth_rad, row.own_azimuth_rad, row.own_edge) == (0.004, None, None)


def test_a_step_within_the_day_is_noted_where_the_radar_is_named():
    mine, other, _ = rows_of(record(np.eye(4), np.eye(4)), record(np.eye(4), np.eye(4), child_frame="nose"))
    assert (
        mine.notes[-1] == "the corner's own software changed its alignment at 22:13 UTC: +0.30 deg in azimuth"
    )
    assert not [n for n in other.notes if "software" in n]


def test_a_day_without_such_messages_is_as_before():
    records = [record(np.eye(4), np.eye(4))]
    assert with_alignments(records, None, ABOUT) == records
