"""Two cameras, a lidar and two radars through ingest and perceive: each has files and features of its own."""

import shutil
from operator import attrgetter

import numpy as np
import pytest

from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE
from pipeline.ingest import index
from pipeline.rig.day_prior import prior_of_three, rig_prior
from pipeline.rig.se3 import inverse, log_se3
from pipeline.store.moments import sensors_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested, observations_of, perceived
from schemas.calibrations import CalibrationRecord
from schemas.moments import PRIOR, SENSORS_ABSENT
from schemas.observations import WITHOUT_LABELS
from schemas.poses import PoseRow
from tests.makers.simulated_days import simulated_day
from tests.makers.stages import ingest_day, perceive_day

pytestmark = pytest.mark.slow
DAY = Partition("vehicle-1", "2026-03-02")
KINDS = {"front": "camera", "left": "camera", "top": "lidar", "nose": "radar", "corner_fl": "radar"}


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """The day's lake, configuration, truth, and outcomes; the left radar is silent in its second half."""
    about = {"rig": "duo", "seed": 5, "faults": "vehicle-1:0:corner_fl:missing:1@0.5"}
    made = simulated_day(tmp_path_factory.mktemp("duo"), frames=8, drives=1, **about)
    return made.lake, made.fleet, made.told, made.outcomes


def test_every_sensor_has_a_file_and_what_it_lacks_is_counted_under_its_name(day):
    lake, _, _, (ingest, perceive) = day
    assert (ingest.status, perceive.status, perceive.rows) == ("done", "done", ingest.rows)
    assert sensors_of(ingested(lake, DAY)).keys() == sensors_of(perceived(lake, DAY)).keys() == KINDS.keys()
    assert sensors_of(ingested(lake, DAY)) == KINDS
    assert ingest.rejected["without_corner_fl_no_radar_in_gate"] >= 2
    assert "corner_fl" in ingested(lake, DAY).extra[SENSORS_ABSENT]


@pytest.mark.parametrize(
    ("of_camera", "counts"),
    # Of every second image that is read some are earlier ones, which show a motion and cost no moment.
    [(attrgetter("image"), (3, 0)), (attrgetter("semantics.labels"), (0, 4))],
    ids=["images", "labels"],
)
def test_what_is_damaged_of_one_camera_costs_that_camera_alone(day, tmp_path, monkeypatch, of_camera, counts):
    lake, fleet, _, (before, perceived_before) = day
    topic, whole, seen = of_camera(fleet.rig_of(DAY.vehicle).cameras["left"]), index.decode, []

    def damaged(channel, data):
        seen.append(channel.topic)
        is_bad = seen[-1] == topic and seen.count(topic) % 2 == 0
        return whole(channel, data[: len(data) // 2] if is_bad else data)

    monkeypatch.setattr(index, "decode", damaged)
    logs = sorted((lake.root.parent / "logs" / DAY.vehicle / DAY.day).iterdir())
    copy = Lake.at(tmp_path / "lake")
    found, shown = ingest_day(logs, DAY, fleet, copy), perceive_day(DAY, fleet, copy)
    assert (found.status, found.rows, shown.rows) == ("done", before.rows, perceived_before.rows)
    lost = found.rejected.get("without_left_image_damaged", 0)
    assert (lost, shown.rejected.get("without_left_labels_missing", 0)) == counts


def test_a_camera_without_semantics_is_aligned_by_brightness_and_records_poses_and_outcomes_say_so(
    day, tmp_path
):
    lake, fleet, _, (_, before) = day
    copy = Lake.at(tmp_path / "lake")
    shutil.copytree(lake.root, copy.root)
    name, rig = next(iter(fleet.rigs.items()))
    bare = rig.cameras | {"left": rig.cameras["left"].model_copy(update={"semantics": None})}
    fleet = fleet.model_copy(update={"rigs": {name: rig.model_copy(update={"cameras": bare})}})
    found = perceive_day(DAY, fleet, copy)
    assert (found.status, found.rows) == ("done", before.rows)
    assert f"left: {WITHOUT_LABELS}" in found.reason
    assert "[rigs.duo.cameras.left.semantics]" in found.reason
    outcome = CALIBRATE.run(Task(fleet, copy, DAY))
    assert f"left: {WITHOUT_LABELS}" in outcome.reason
    records = [r for r in outcome.records if isinstance(r, CalibrationRecord)]
    noted = {(r.parent_frame, r.pair) for r in records if WITHOUT_LABELS in r.notes}
    assert noted == {("left", "camera_lidar")}
    with_radar = [r for r in records if r.parent_frame == "left" and r.pair == "camera_radar"]
    assert all((r.status, r.faults) == ("refused", ["no_labels"]) for r in with_radar)
    poses = {r.sensor: r.notes for r in outcome.records if isinstance(r, PoseRow)}
    assert {sensor for sensor, notes in poses.items() if WITHOUT_LABELS in notes} == {"left"}


def test_the_prior_is_kept_once_and_ties_every_sensor_to_the_lidar(day):
    lake, fleet, truth, _ = day
    rows = ingested(lake, DAY).extra[PRIOR]
    assert rows == perceived(lake, DAY).extra[PRIOR]
    rig = fleet.rig_of(DAY.vehicle)
    prior = rig_prior(rows, fleet, rig)
    base = {name: np.array(T) for name, T in truth["T_base_sensor"].items()}
    for name in KINDS:
        T = prior.between("top", name)
        assert np.abs(log_se3(inverse(inverse(base["top"]) @ base[name]) @ T))[:3].max() < np.radians(12)
    three = prior_of_three(prior, rig, "left", "top", "nose")
    seen = next(observations_of(lake, DAY, chosen={"camera": "left", "lidar": "top", "radar": "nose"}))
    np.testing.assert_array_equal(three.T_camera_lidar, seen.priors["camera_lidar"])
    np.testing.assert_array_equal(three.T_lidar_radar, seen.priors["lidar_radar"])
