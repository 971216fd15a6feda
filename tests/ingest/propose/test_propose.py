"""`boresight init`: logs alone give a fleet.toml that runs; what they do not show is a comment, never a guess."""

import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from jobs.cli import main
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.rigs import RadarTopics
from pipeline.fleet.pattern import find_vehicle_days
from pipeline.ingest.directions_and_units import AskedRadar
from pipeline.ingest.propose.propose import doppler_period, propose_fleet
from pipeline.ingest.propose.survey import logs_pattern, nightly_command
from pipeline.store.partitions import Partition
from tests.makers.written_logs import (
    DETECTIONS,
    HEIGHT,
    LABELS,
    PERIOD_NS,
    RADAR,
    START_NS,
    WIDTH,
    Kit,
    radar_columns,
)


def with_labels(made, pixels):
    def label(_, at):
        return made.compressed(at + 1_000_000, cv2.imencode(".png", pixels())[1].tobytes(), "png")

    return made.each(LABELS, label)


def drive(frames=12, **kit):
    rows = np.array([*range(10), 255], np.uint8)[np.arange(HEIGHT) % 11]  # 255 is void
    return with_labels(Kit(frames=frames, **kit).drive(), lambda: np.tile(rows[:, None], WIDTH))


def with_doppler(made, change):
    def scan(i, at):
        return made.cloud(at - 2_000_000, change(radar_columns(i)), frame_id="radar")

    return made.each(RADAR, scan)


def proposed(*logs):
    found = propose_fleet(list(logs), "ours")
    return tomllib.loads(found.text), found


def test_a_trio_of_a_drive_is_found_with_all_its_topics_in_every_container(tmp_path):
    made = drive()
    for log in (
        made.mcap(tmp_path / "a.mcap"),
        made.folder(tmp_path / "bag"),
        drive(ros=1).bag(tmp_path / "a.bag"),
    ):
        values, found = proposed(log)
        rig = values["rigs"]["default"]
        assert rig["camera"]["image"] == "/camera/image"
        assert rig["camera"]["info"] == "/camera/info"
        assert rig["camera"]["semantics"] == {"source": "topics", "labels": LABELS, "detections": DETECTIONS}
        assert rig["lidar"] == {"points": "/lidar/points"}
        assert rig["radar"]["points"] == "/radar/points"
        assert rig["radar"]["doppler_field"] == "doppler"
        assert "10 labels from 0 to 9: taken for Cityscapes train ids" in found.text
        assert found.missing == ()


@pytest.mark.parametrize(("sign", "word"), [(1.0, "approaching"), (-1.0, "receding"), (0.0, None)])
def test_the_doppler_s_sign_is_read_off_the_drive_and_a_standing_car_leaves_it_to_the_reader(
    tmp_path, sign, word
):
    log = with_doppler(drive(), lambda c: c | {"doppler": sign * c["doppler"]}).mcap(tmp_path / "a.mcap")
    values, found = proposed(log)
    assert values["rigs"]["default"]["radar"].get("doppler_positive") == word
    assert ('# doppler_positive = "receding"' in found.text) == (word is None)
    assert found.missing == (() if word else ("radar: the Doppler's sign",))


def test_a_doppler_that_wraps_is_told_from_one_that_does_not(tmp_path):
    period, step = 12.0, 0.1

    def wrapped(columns):
        raw = np.round(columns["doppler"] * 2.1 / step) * step  # 21 m/s
        return columns | {"doppler": ((raw + period / 2) % period - period / 2).astype(np.float32)}

    values, _ = proposed(with_doppler(drive(24), wrapped).mcap(tmp_path / "a.mcap"))
    assert values["rigs"]["default"]["radar"]["doppler_period_mps"] == pytest.approx(period, abs=2 * step)
    values, _ = proposed(drive(24).mcap(tmp_path / "b.mcap"))
    assert "doppler_period_mps" not in values["rigs"]["default"]["radar"]
    assert doppler_period([], AskedRadar("radar", RadarTopics(points=RADAR))) is None


def test_components_of_a_velocity_are_named_and_those_over_ground_are_not(tmp_path):
    def components(columns):
        rate = -columns.pop("doppler")
        r = np.sqrt(columns["x"] ** 2 + columns["y"] ** 2)
        over_ground = {"vx_comp": 0 * rate, "vy_comp": 0 * rate}
        return columns | over_ground | {"vx": rate * columns["x"] / r, "vy": rate * columns["y"] / r}

    values, _ = proposed(with_doppler(drive(), components).mcap(tmp_path / "a.mcap"))
    radar = values["rigs"]["default"]["radar"]
    assert radar["velocity_fields"] == ["vx", "vy"]
    assert "doppler_field" not in radar


def test_without_labels_a_camera_is_told_what_it_lacks_and_the_rest_runs(tmp_path):
    made = drive().without(LABELS)
    (tmp_path / "fleet.toml").write_text(propose_fleet([made.mcap(tmp_path / "a.mcap")], "ours").text)
    camera = load_fleet(tmp_path / "fleet.toml").rigs["default"].camera
    assert camera.semantics is None
    assert "# semantics = { source" in (tmp_path / "fleet.toml").read_text()


def test_a_grey_picture_is_no_label_image(tmp_path):
    rng = np.random.default_rng(0)
    made = with_labels(
        drive(), lambda: cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8), (9, 9), 2)
    )
    _, found = proposed(made.mcap(tmp_path / "a.mcap"))
    assert any(m.startswith("camera: semantics") for m in found.missing)


def test_several_sensors_of_a_kind_are_called_by_their_frames_and_get_the_vehicle_s(tmp_path):
    made = drive()
    for i in range(made.frames):
        stamp = START_NS + i * PERIOD_NS
        scan = made.cloud(stamp, radar_columns(i + 50), frame_id="radar_left_link")
        made.add("/radar/left/points", "sensor_msgs/msg/PointCloud2", stamp, scan)
    values, found = proposed(made.mcap(tmp_path / "a.mcap"))
    rig = values["rigs"]["default"]
    assert set(rig["radars"]) == {"radar", "radar_left"}
    assert rig["base"] == "base_link"
    # no chain of transforms to it, so nothing shows where it looks
    unknown = ("prior: transforms between the sensors", "radar_left: the Doppler's sign")
    assert found.missing == unknown
    assert "radar_left (radar_left_link)" in found.text


def test_of_two_clouds_of_one_lidar_the_raw_one_is_taken_and_the_other_is_named(tmp_path):
    made = drive()
    for i in range(made.frames):
        stamp = START_NS + i * PERIOD_NS
        xyz = {n: np.ones(50, np.float32) for n in "xyz"}
        made.add("/lidar/ground", "sensor_msgs/msg/PointCloud2", stamp, made.cloud(stamp, xyz))
    values, found = proposed(made.mcap(tmp_path / "a.mcap"))
    assert values["rigs"]["default"]["lidar"]["points"] == "/lidar/points"
    assert "#   /lidar/ground (second topic of lidar lidar)" in found.text


def test_one_sensor_alone_is_refused_with_what_the_log_holds(tmp_path):
    log = drive().without("/radar/points").without("/camera/info").mcap(tmp_path / "a.mcap")
    with pytest.raises(
        ConfigError, match=r"fewer than two of camera, lidar and radar; there are .*/camera/image"
    ):
        propose_fleet([log], "ours")


def test_the_command_writes_once_and_says_what_to_type_next(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "logs" / "car-1" / "2023-11-14"
    folder.mkdir(parents=True)
    drive().mcap(folder / "a.mcap")
    monkeypatch.chdir(tmp_path)
    assert main(["init", "logs/car-1/2023-11-14/a.mcap"]) == 0
    said = capsys.readouterr().out
    assert "boresight check fleet.toml logs/car-1/2023-11-14/a.mcap" in said
    assert '"logs/{vehicle}/{day}/*\\"' in said  # a log of another format beside it is read too
    before = Path("fleet.toml").read_text()
    assert main(["init", "logs/car-1/2023-11-14/a.mcap"]) == 2
    assert Path("fleet.toml").read_text() == before
    assert main(["check", "fleet.toml", "logs/car-1/2023-11-14/a.mcap"]) in (0, 1)
    following = 'boresight nightly --fleet fleet.toml --lake lake --logs "logs/{vehicle}/{day}/*"'
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["next_steps"] == [following]


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (["in/car/2026-03-02/raw/a.bag"], "in/{vehicle}/{day}/raw/*"),
        (["in/a/2026-03-02/x.bag", "in/b/2026-03-02/y.mcap", "in/notes.txt"], "in/{vehicle}/{day}/*"),
        (["logs/LICENSE.txt", "logs/a_2026-03-02_0.mcap", "logs/a_2026-03-02_1.bag"], "logs/{vehicle}_{day}*"),
        (["drive.mcap"], ""),
    ],
)  # fmt: skip
def test_the_pattern_is_that_of_folders_and_names_whatever_lies_beside(names, pattern):
    assert logs_pattern([Path(name) for name in names]) == pattern


def test_the_pattern_of_names_without_dashes_finds_the_day(tmp_path):
    logs = [tmp_path / f"veh00_20260302_0{hour}00.mcap" for hour in (8, 9)]
    for log in logs:
        log.touch()
    (found,) = find_vehicle_days(logs_pattern(logs))
    assert (found.partition, len(found.logs)) == (Partition("veh00", "2026-03-02"), 2)


def test_logs_whose_names_tell_no_day_are_to_be_moved_before_the_night():
    first, then = nightly_command(Path("fleet.toml"), [Path("drive.mcap")])
    assert first == "move each log to logs/VEHICLE/DAY/, as logs/car-1/2026-05-31/drive.mcap"
    assert then.endswith('--logs "logs/{vehicle}/{day}/*"')


@pytest.mark.real_logs
def test_the_real_car_s_sign_and_period_are_read_off_its_logs(real_logs):
    values, found = proposed(*sorted(real_logs.glob("astyx-1*")))
    radar = values["rigs"]["default"]["radar"]
    assert radar["doppler_positive"] == "approaching"
    assert radar["doppler_period_mps"] == pytest.approx(10.394, abs=0.01)
    assert found.missing == ()


@pytest.mark.real_logs
def test_kitti_lacks_its_semantics_alone(kitti_logs):
    values, found = proposed(*kitti_logs.glob("*.mcap"))
    assert set(values["rigs"]["default"]) == {"camera", "lidar", "prior"}
    assert found.missing == ("camera: semantics (recommended; no labels: borders are brightness steps)",)
