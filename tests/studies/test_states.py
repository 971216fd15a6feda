"""What study `states` counts: errors of a known turn, what is wrong, and what a file of a known state holds."""

import tomllib

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.export.files import write_files, written_files
from pipeline.export.formats import format_named
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse
from tests.benchmarks.results_measures import MEASURES
from tests.benchmarks.studies.states_fleet import (
    fleet_text,
    logged_poses,
    spec_of_day,
    stories_of,
    tomorrows_poses,
)
from tests.benchmarks.studies.states_measures import (
    Entry,
    apart,
    between,
    counts,
    is_farther,
    is_right,
    is_wrong,
    measure,
    nights_until_right,
    read_file,
    readme_text,
    sigmas_off,
    summary,
)
from tests.makers.calibrations import T_CAMERA_LIDAR, T_LIDAR_RADAR, calibration

KINDS = {"camera_lidar": ("camera", "lidar"), "lidar_radar": ("lidar", "radar")}
# T_base_sensor of the made calibration, with the lidar at the car's base.
TRUTH = {
    "base": np.eye(4), "lidar": np.eye(4), "camera": inverse(T_CAMERA_LIDAR), "radar": T_LIDAR_RADAR,
}  # fmt: skip


def turned(T, degrees):
    """T_parent_child with the child turned about the parent's axes by a rotation vector [deg], its origin kept."""
    return from_rotation_translation(exp_so3(np.radians(np.array(degrees))) @ T[:3, :3], T[:3, 3])


def row(pair="camera_lidar", degrees=(0.0, 0.0, 0.0), **told):
    """A measured line of an edge that is turned, its prior by 2 deg and its record by .3 deg about the first axis."""
    parent, child = KINDS[pair]
    T = between(TRUTH, parent, child)
    sigma = np.r_[np.full(3, np.radians(0.1)), np.full(3, 0.01)]
    given = {"certified": ("azimuth", "elevation"), "status": "current", "sigma": sigma} | told
    entry = Entry("edge", parent, child, turned(T, degrees), **given)
    others = {"prior": turned(T, (2.0, 0, 0)), "record": turned(T, (0.3, 0, 0))}
    return measure(entry, KINDS[pair], TRUTH, others)


@pytest.mark.parametrize(
    ("pair", "degrees", "azimuth", "elevation"),
    [
        ("camera_lidar", (0.0, 0.5, 0.0), 0.5, 0.0),
        ("camera_lidar", (0.5, 0.0, 0.0), 0.0, 0.5),
        ("lidar_radar", (0.0, 0.0, 0.5), 0.5, 0.0),
    ],
)
def test_a_turn_is_an_error_of_its_axis_and_direction_in_degrees_and_in_sigmas(
    pair, degrees, azimuth, elevation
):
    # The child turns about its origin, 1 m and 2 m from the parent's: 2 % of the angle at these targets at most.
    found = row(pair, degrees)
    assert found["file"]["error"] == pytest.approx([*degrees, 0, 0, 0], abs=1e-9)
    assert found["file"]["az_deg"] == pytest.approx(azimuth, abs=0.06)
    assert found["file"]["el_deg"] == pytest.approx(elevation, abs=0.06)
    assert sorted(sigmas_off(found)) == pytest.approx([0, 0, 0, 0, 0, 5.0], abs=1e-6)
    assert (found["prior"]["turn_deg"], found["record"]["turn_deg"]) == pytest.approx((2.0, 0.3))


def test_wrong_is_what_is_certified_beyond_the_limit_of_its_direction():
    off = (0.0, 0.4, 0.0)  # azimuth; the limit of camera-lidar is .2 deg
    assert is_wrong(row(degrees=off))
    assert not is_wrong(row(degrees=off, certified=("elevation",)))
    assert not is_wrong(row(degrees=(0.0, 0.1, 0.0)))
    assert not is_right(row(degrees=off, certified=()))
    assert not is_wrong(row("lidar_radar", (0.0, 0.0, 0.3)))  # .4 deg for a radar
    assert is_wrong(row("lidar_radar", (0.0, 0.0, 0.6)))


def test_a_file_is_farther_off_only_where_it_is_than_both_others():
    assert is_farther(row(degrees=(0.0, 0.0, 2.3)))
    assert not is_farther(row(degrees=(0.0, 0.0, 1.9)))
    assert not is_farther(row(degrees=(0.0, 0.0, 2.05)))
    assert is_farther(row(degrees=(0.0, 0.0, 2.05)), 0, 0)


def test_axes_at_the_prior_do_not_count_in_sigmas():
    at_prior = (True, True, False, True, True, True)
    assert sigmas_off(row(degrees=(0.0, 0.0, 2.0), used=at_prior)).max() == pytest.approx(0, abs=1e-6)
    assert sigmas_off(row(degrees=(0.0, 0.0, 2.0))).max() == pytest.approx(20)


def nights(*degrees):
    """A vehicle whose camera was knocked on the second day, by the error of its files; None = not in the file."""
    about = {
        "rig": "demo",
        "vehicle": "v",
        "story": "camera 1",
        "moved": "camera",
        "knock": True,
        "moved_on": 1,
    }
    found = []
    for night, off in enumerate(degrees):
        one = row(degrees=(0.0, off or 0.0, 0.0)) | about | {"night": night, "ros2_apart": None}
        found.append(one | ({"file": None} if off is None else {}))
    return found


def test_nights_from_a_knock_until_right_end_where_every_edge_of_the_sensor_is_within_its_limits():
    assert nights_until_right(nights(0.0, 0.05)) == 0
    assert nights_until_right(nights(0.0, 0.5, None, 0.1)) == 2
    assert nights_until_right(nights(0.0, 0.5, 0.5)) is None


def test_the_summary_counts_what_the_lines_hold():
    rows = nights(0.0, 0.5, 0.05)
    text = summary(rows)
    assert "| wrong and certified | 1 of 3 (1 to 91 %) |" in text
    assert "| nights from a knock until right | v (camera 1): 1 |" in text
    assert "demo v (camera 1, moved on 2) night 2 edge camera-lidar: WRONG and certified" in text
    told = readme_text([r | {"seed": 1, "commit": "abc"} for r in rows])
    for made in tomllib.loads(told[: told.index("`python")])["row"]:
        assert MEASURES[made["measure"]](rows, made) == counts(rows)[made["count"]]


def test_a_written_file_is_read_back_axis_by_axis(tmp_path):
    form = format_named("ros2")
    write_files(written_files(form, calibration(), tmp_path))
    entries = read_file(tmp_path)
    assert [(e.what, e.parent, e.child) for e in entries] == [
        ("edge", "camera", "lidar"), ("edge", "camera", "radar"), ("edge", "lidar", "radar"),
        ("pose", "lidar", "camera"), ("pose", "lidar", "radar"),
    ]  # fmt: skip
    for entry in entries:
        T = between(TRUTH, entry.parent, entry.child)
        np.testing.assert_allclose(entry.T, T, atol=1e-12)
        assert entry.used == (True,) * 6
    assert np.isfinite(entries[0].sigma).all()
    assert apart(tmp_path, entries) == pytest.approx((0, 0), abs=1e-9)
    path = tmp_path / "static_transforms.launch.yaml"
    path.write_text(path.read_text().replace("--x 2.0", "--x 2.5"))
    assert apart(tmp_path, entries)[1] == pytest.approx(0.5)
    assert read_file(tmp_path / "nothing") == []


def test_the_fleet_has_a_third_that_stands_still_and_far_priors_that_its_file_admits(tmp_path):
    stories = stories_of("duo", 71001, 12)
    assert sum(not story.sensor for story in stories) == 4
    (tmp_path / "fleet.toml").write_text(fleet_text("duo", stories))
    config = load_fleet(tmp_path / "fleet.toml")
    for number, story in enumerate(stories):
        logged = logged_poses("duo", 71001, stories, number)
        true = tomorrows_poses("duo", 71001, stories, number, 0)
        T, T_true = (between(poses, "front", "top") for poses in (logged, true))
        off = np.degrees(np.arccos((np.trace(T[:3, :3].T @ T_true[:3, :3]) - 1) / 2))
        assert (off > 3.0) == story.is_far
        assert config.rig_of(story.vehicle).prior.rotation_sigma_deg == (5.0 if story.is_far else 2.0)


def test_a_knock_is_in_tomorrows_truth_from_the_night_after_its_day_and_daily_scatter_always():
    stories = stories_of("demo", 71001, 2)
    knocked = stories[1]
    moved = []
    for night in range(6):
        before, after = (tomorrows_poses("demo", 71001, stories, 1, n)["camera"] for n in (night, night + 1))
        moved.append(np.degrees(np.arccos((np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2)))
    assert int(np.argmax(moved)) + 1 == knocked.moved_on
    assert max(moved) == pytest.approx(1.0, abs=0.15)
    assert 0 < sorted(moved)[-2] < 0.2  # the mounts' scatter of .02 deg an axis


def test_labels_are_coarse_on_one_vehicle_only():
    stories = stories_of("demo", 71001, 12)
    wide = [spec_of_day("demo", 71001, stories, 40, n, 0).semantics.boundary_px for n in range(12)]
    assert [n for n, px in enumerate(wide) if px > 2] == [3]
