"""Mistakes of fleet.toml, of --logs and of the recording are named with their correction, by every command."""

import html
import json
import subprocess
import sys

import pytest

from tests.makers.commands import command
from tests.makers.fleet_files import fleet_toml
from tests.makers.written_logs import DETECTIONS, IMAGE, INFO, LABELS, LIDAR, START_NS, Kit

DAY = "2023-11-14"
CALIBRATED = "log a sensor_msgs/CameraInfo with a calibrated K"


def driven(folder, made=None, vehicle="car", name="a.mcap"):
    """A log of a vehicle in its folder, and its path."""
    log = folder / "logs" / vehicle / DAY / name
    log.parent.mkdir(parents=True, exist_ok=True)
    return (made or Kit(frames=12).drive()).mcap(log)


def configured(folder, *vehicles, old="", new=""):
    small = "[ingest]\nmin_lidar_points = 500\n"
    sign = 'doppler_positive = "approaching"'
    text = fleet_toml(*(vehicles or ("car",)), sections=small, radar=sign)
    assert old in text
    (folder / "fleet.toml").write_text(text.replace(old, new))
    return folder / "fleet.toml"


def night(folder, capsys, logs="*", *more):
    """Exit code and summary of a night."""
    options = ["--lake", f"{folder}/lake", "--logs", f"{folder}/logs/{{vehicle}}/{{day}}/{logs}"]
    options += ["--executor", "inline", "--no-pictures", *more]
    return command(capsys, "nightly", "--fleet", f"{folder}/fleet.toml", *options)[:2]


def status(folder, capsys, *more):
    return command(capsys, "status", "--lake", f"{folder}/lake", *more)[:2]


def check(folder, log, capsys):
    asked = ("check", f"{folder}/fleet.toml", log)
    code, report, *_ = command(capsys, *asked, "--json")
    told = command(capsys, *asked)
    assert told.code == code
    return report, told.summary["next_steps"]


def on_pages(folder):
    """Text of the fleet page, and of each page of a day."""
    report = folder / "lake/report"
    pages = [report / "fleet.html", *sorted(report.glob("fleet_days/*/*.html"))]
    assert len(pages) == 2
    return [html.unescape(page.read_text()) for page in pages]


def assert_on_pages(folder, step):
    fleet, day = on_pages(folder)
    assert f"<li>{step}</li>" in fleet
    for page in (fleet, day):
        assert f"To do for {step}" in page
        assert "drive until" not in page


MISTYPED = (
    "/lidar/point (lidar): no message; the same type comes on /lidar/points: correct the topic in fleet.toml"
)


def test_a_mistyped_topic_is_misconfigured_though_the_night_goes_on_with_the_other_sensors(tmp_path, capsys):
    log = driven(tmp_path)
    configured(tmp_path, old='"/lidar/points"', new='"/lidar/point"')
    step = f"car: {MISTYPED}; then run the night again."
    for _ in range(2):  # the second night makes nothing again
        code, summary = night(tmp_path, capsys)
        (problem,) = summary["problems"]
        assert (code, summary["misconfigured"], summary["next_steps"]) == (2, {"default": MISTYPED}, [step])
        assert MISTYPED in problem["reason"]
    code, of_status = status(tmp_path, capsys)
    audited = command(capsys, "audit", "--fleet", f"{tmp_path}/fleet.toml", "--lake", f"{tmp_path}/lake")
    assert audited.code == 0
    for summary in (of_status, audited.summary):
        assert (summary["misconfigured"], summary["next_steps"]) == ({"car": MISTYPED}, [step])
    assert_on_pages(tmp_path, step)
    _, steps = check(tmp_path, log, capsys)
    assert steps == [MISTYPED, f"boresight check {tmp_path}/fleet.toml {log}"]
    configured(tmp_path)
    code, summary = night(tmp_path, capsys)
    assert (code, summary["misconfigured"]) == (3, {})
    assert status(tmp_path, capsys)[1]["misconfigured"] == {}
    assert not any(MISTYPED in to_do for to_do in on_pages(tmp_path))


def test_a_silent_sensor_of_a_rig_that_is_right_is_no_mistake_of_fleet_toml(tmp_path, capsys):
    driven(tmp_path, Kit(frames=12).drive().without(LIDAR))  # the radar's cloud is of the rig, and no lidar's
    configured(tmp_path)
    code, summary = night(tmp_path, capsys)
    assert (code, summary["misconfigured"]) == (3, {})


@pytest.mark.parametrize(
    ("old", "new", "role"),
    [(LABELS, "/perception/label", "labels"), (DETECTIONS, "/perception/detection", "detections")],
)
def test_a_mistyped_topic_of_semantics_is_named_with_the_one_like_it(tmp_path, capsys, old, new, role):
    log = driven(tmp_path)
    configured(tmp_path, old=f'"{old}"', new=f'"{new}"')
    named = f"{new} ({role}): no message; the same type comes on {old}: correct the topic in fleet.toml"
    assert night(tmp_path, capsys)[1]["misconfigured"] == {"default": named}
    assert named in check(tmp_path, log, capsys)[1]


def test_labels_that_are_not_logged_are_not_taken_for_another_image(tmp_path, capsys):
    made = Kit(frames=12).drive().without(LABELS)
    made.messages += [("/rear/image", *m[1:]) for m in made.messages if m[0] == IMAGE]
    log = driven(tmp_path, made)
    configured(tmp_path)
    assert night(tmp_path, capsys)[0] == 3
    report, steps = check(tmp_path, log, capsys)
    said = next(v["reasons"][0] for v in report["verdicts"] if v["pair"] == "camera_lidar")
    assert "remove `semantics` from fleet.toml" in said
    assert steps[0] == "boresight models --fetch"
    assert report["corrections"] == []


def test_a_topic_of_another_type_is_a_mistake(tmp_path, capsys):
    configured(tmp_path, old=f'"{LIDAR}"', new=f'"{DETECTIONS}x"')
    made = Kit(frames=12).drive()
    made.messages += [(f"{DETECTIONS}x", *m[1:]) for m in made.messages if m[0] == DETECTIONS]
    driven(tmp_path, made)
    named = night(tmp_path, capsys)[1]["misconfigured"]["default"]
    wrong = "type vision_msgs/msg/Detection2DArray, not sensor_msgs/msg/PointCloud2"
    assert f"{DETECTIONS}x (lidar): {wrong}" in named


@pytest.mark.parametrize("how", ["not logged", "not calibrated"])
def test_a_camera_without_intrinsics_is_named_by_every_command(tmp_path, capsys, how):
    made = Kit(frames=12).drive()
    for i in range(12):
        made.replaced(INFO, i, made.info(START_NS + i * 100_000_000, focal_px=0.0))
    log = driven(tmp_path, made.without(INFO) if how == "not logged" else made)
    configured(tmp_path)
    code, summary = night(tmp_path, capsys)
    assert code == 2
    assert CALIBRATED in summary["misconfigured"]["default"]
    assert INFO in summary["misconfigured"]["default"]
    report, steps = check(tmp_path, log, capsys)
    assert any(INFO in step and CALIBRATED in step for step in steps)
    assert not any("models --fetch" in step or "nightly" in step for step in steps)
    reasons = {v["pair"]: " ".join(v["reasons"]) for v in report["verdicts"]}
    assert "labels on the topics" not in " ".join(reasons.values())
    assert CALIBRATED in reasons["camera_lidar"]
    assert CALIBRATED not in reasons["lidar_radar"]
    out = tmp_path / "found.toml"
    (problem,) = command(capsys, "init", log, "--out", out).summary["problems"]
    assert problem.startswith(f"Camera left out: no usable CameraInfo of {IMAGE}")
    assert f"# {problem}" in out.read_text()


def test_a_vehicle_that_fleet_toml_lacks_is_named_and_the_others_go_on(tmp_path, capsys):
    for vehicle in ("car", "carr"):
        driven(tmp_path, Kit(frames=4).drive(), vehicle)
    configured(tmp_path)
    for _ in range(2):
        code, summary = night(tmp_path, capsys)
        assert code == 2
        (said,) = summary["misconfigured"].values()
        assert "has no vehicle 'carr'; it has car: add [vehicles.\"carr\"] with its rig" in said
        named = {p["vehicle"]: said in p["reason"] for p in summary["problems"]}
        assert named == {"car": False, "carr": True}
    code, summary = status(tmp_path, capsys, "--json")
    assert summary["misconfigured"] == {"carr": said}
    day = next(d for d in summary["days"] if d["vehicle"] == "carr")
    assert (day["status"], day["reason"], day["faults"]) == ("refused", said, ["configuration"])
    configured(tmp_path, "car", "carr")
    assert night(tmp_path, capsys)[0] == 3
    assert status(tmp_path, capsys)[1]["misconfigured"] == {}


def test_logs_that_the_pattern_leaves_out_for_their_format_are_named_with_the_pattern_to_use(
    tmp_path, capsys
):
    log = driven(tmp_path, Kit(frames=4).drive())
    Kit(frames=4, ros=1).drive(START_NS + 10**11).bag(log.parent / "b.bag")
    Kit(frames=4).drive(START_NS + 2 * 10**11).folder(log.parent / "c")
    (log.parent / "notes.txt").write_text("none of ours")
    configured(tmp_path)
    wider = f"{tmp_path}/logs/{{vehicle}}/{{day}}/*"
    said = f'--logs leaves out 2 logs of 1 vehicle-day in another format, as {log.parent}/b.bag: use --logs "{wider}"'
    _, planned = night(tmp_path, capsys, "*.mcap", "--dry-run")
    assert planned["logs_left_out"] == said
    _, summary = night(tmp_path, capsys, "*.mcap")
    assert summary["logs_left_out"] == said
    assert summary["next_steps"][0] == said
    _, summary = night(tmp_path, capsys)
    assert summary["logs_left_out"] == ""
    assert said not in summary["next_steps"]
    code, failed = night(tmp_path, capsys, "*.db3")
    assert code == 2
    said = f'--logs leaves out 3 logs of 1 vehicle-day in another format, as {log}: use --logs "{wider}"'
    assert said in failed["reason"]


def test_an_unknown_vehicle_of_a_lake_is_an_error_that_names_those_it_has(tmp_path, capsys):
    driven(tmp_path, Kit(frames=4).drive())
    configured(tmp_path)
    night(tmp_path, capsys)
    of_lake, out = ("--lake", f"{tmp_path}/lake"), ("--out", f"{tmp_path}/out")
    for name in ("state", "status"):
        assert command(capsys, name, *of_lake, "--vehicle", "car").code == 0
    for asked in (["state"], ["status"], ["export", "ros2", *out], ["export", "ros2", *out, "--day", DAY]):
        told = command(capsys, *asked, *of_lake, "--vehicle", "kar")
        assert told.code == 2
        assert told.summary["reason"].endswith("the lake has no day of 'kar'; it has car")


def test_without_transforms_the_next_step_is_a_prior(tmp_path, capsys):
    log = driven(tmp_path, Kit(frames=12).drive().without("/tf_static"))
    configured(tmp_path)
    _, steps = check(tmp_path, log, capsys)
    assert "the logs have no tf_static chain" in steps[0]
    assert "boresight import" in steps[0]
    assert not any("nightly" in step for step in steps)


def test_an_error_is_printed_once_where_both_streams_go_to_one_place(tmp_path):
    call = [sys.executable, "-m", "jobs.cli", "status", "--lake", f"{tmp_path}/none"]
    told = subprocess.run(call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert told.stdout.count("no such folder") == 1
    assert json.loads(told.stdout.splitlines()[-1])["exit_code"] == told.returncode == 2
    apart = subprocess.run(call, capture_output=True, text=True, check=False)
    assert [s.count("no such folder") for s in (apart.stdout, apart.stderr)] == [1, 1]
