"""The real vehicle-day: all frames of three containers, untouched."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from pipeline.core.config import load_fleet
from pipeline.ingest.check import check_logs
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from tests.makers.stages import ingest_day

pytestmark = pytest.mark.real_logs
CONFIG = Path(__file__).parent.parent / "end_to_end" / "astyx.toml"
CLOUDS = ("/lidar/top/points", "/radar/front/points")
DAY = Partition("astyx-1", "2019-01-14")


@pytest.fixture(scope="module")
def logs(real_logs):
    return sorted(real_logs.glob("astyx-1_*"))


@pytest.fixture(scope="module")
def lake(logs, tmp_path_factory):
    lake = Lake.at(tmp_path_factory.mktemp("real"))
    result = ingest_day(logs, DAY, load_fleet(CONFIG), lake)
    assert (result.status, result.rows, result.reason) == ("done", 187, "")
    return lake


def test_every_frame_of_the_day_is_there_with_the_bytes_and_points_of_the_logs(logs, lake):
    frames = frames_of(lake, DAY)
    seen = Counter()
    for log in logs:  # their names sort by time
        for expected in logged(log):
            frame = next(frames)
            assert frame.log == log.name
            assert frame.frame_index == sum(seen.values())
            seen[log.name] += 1
            check_against_log(frame, expected)
    assert next(frames, None) is None
    assert sorted(seen.values()) == [46, 46, 46, 49]


def check_against_log(frame, expected):
    image, sweep, scan = (expected[t] for t in ("/camera/front/image/compressed", *CLOUDS))
    assert frame.image == bytes(image.data)
    assert frame.labels_png == bytes(expected["/perception/camera/labels"].data)
    assert len(frame.detection_classes) == len(expected["/perception/camera/detections"].detections)
    points = np.frombuffer(sweep.data, np.dtype(dtype_of(sweep)))
    xyz = np.stack([points[n] for n in "xyz"], -1)
    near = np.linalg.norm(xyz, axis=1) <= 120
    np.testing.assert_array_equal(frame.lidar_xyz_m, xyz[near])
    np.testing.assert_array_equal(frame.lidar_ring, points["ring"][near])
    detections = np.frombuffer(scan.data, np.dtype(dtype_of(scan)))
    np.testing.assert_array_equal(frame.radar_range_rate_mps, -detections["doppler"])
    assert frame.doppler_period_mps == 10.394
    assert frame.radar_has_elevation


def dtype_of(message):
    kinds = {4: "<u2", 7: "<f4"}
    return {
        "names": [f.name for f in message.fields],
        "formats": [kinds[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }


def logged(log):
    """Messages of a log by stamp, as rosbags' own reader gives them: one dictionary per frame."""
    with AnyReader([log]) as reader:
        current = {}
        for connection, stamp, raw in reader.messages():
            if connection.topic == "/tf_static":
                continue
            if current and current["stamp"] != stamp:
                yield current
                current = {}
            current["stamp"] = stamp
            current[connection.topic] = reader.deserialize(raw, connection.msgtype)
        yield current


def test_the_prior_is_the_calibration_that_the_logs_carry(real_logs, lake):
    given = json.loads((real_logs / "given_calibration.json").read_text())["astyx-1_2019-01-14_00"]
    first = next(frames_of(lake, DAY, [0]))
    for pair, T in (
        ("camera_lidar", np.array(given["T_camera_lidar"])),
        ("lidar_radar", np.linalg.inv(np.array(given["T_radar_lidar"]))),
    ):
        # The logs carry the transforms through single precision rotations of the data set: 1e-6.
        np.testing.assert_allclose(first.priors[pair], T, atol=1e-6)


def _with_radar(rig, **changes):
    return rig.model_copy(update={"radars": {"radar": rig.radar.model_copy(update=changes)}})


def test_check_finds_the_day_fit_and_notices_a_wrong_doppler_sign(logs):
    fleet = load_fleet(CONFIG)
    rig = fleet.rigs["default"]
    report = check_logs(logs, rig, fleet)
    assert report.answer == "yes"
    assert report.evidence.frames == 187
    assert 0.5 < report.evidence.moving_share < 0.95
    assert report.evidence.doppler_problem == ""
    assert {v.verdict for v in report.verdicts if v.pair == "camera_lidar"} == {"yes", "weak"}
    wrong = _with_radar(rig, doppler_positive="receding")
    assert 'probably "approaching"' in check_logs(logs[:1], wrong, fleet).evidence.doppler_problem
    short = _with_radar(rig, doppler_period_mps=5.0)
    assert "doppler_period_mps = 5" in check_logs(logs[:1], short, fleet).evidence.doppler_problem
