"""`boresight check` says what logs can give before anyone spends a night on them."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jobs.check import check
from pipeline.core.errors import ConfigError, ModelError
from pipeline.core.rigs import RadarTopics
from pipeline.ingest.check import check_logs
from pipeline.ingest.directions_and_units import doppler_speed
from pipeline.ingest.readiness import Evidence, judge_edge, overall
from pipeline.rig.rig import Rig
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS
from tests.makers.fleet_files import fleet_toml

GOOD = Evidence(
    frames=120, has_prior=True, labels_share=1.0, detections_share=1.0, has_intensity=True, rings=16,
    elevation_share=1.0, moving_share=0.8,
)  # fmt: skip


def judge(**changes):
    """Verdicts by pair and DoF, and the answer."""
    verdicts = [v for pair in PAIRS for v in judge_edge(pair, pair, replace(GOOD, **changes))]
    return {(v.pair, v.dof): v for v in verdicts}, overall(verdicts)


@pytest.mark.parametrize(
    ("changes", "pair", "dof", "verdict", "reason", "answer"),
    [
        ({}, "camera_lidar", "yaw and roll", "yes", "", "yes"),
        ({"frames": 3}, "camera_lidar", "yaw and roll", "no", "3 usable", "no"),
        ({"has_prior": False}, "lidar_radar", "yaw, x and y", "no", "no prior", "no"),
        ({"elevation_share": 0.0}, "lidar_radar", "roll, pitch and z", "no", "the radar measures no", "partly"),
        ({"elevation_share": 0.0}, "camera_radar", "roll and pitch", "no", "the radar measures no elevation", "partly"),
        ({"labels_share": 0.0}, "camera_lidar", "pitch", "no", "no semantic labels", "partly"),
        ({"labels_share": 0.0, "names_semantics": False}, "camera_radar", "yaw", "no", "no boxes", "partly"),
        ({"moving_share": 0.0}, "lidar_radar", "time offset", "no", "the car moves in 0%", "partly"),
        ({"frames": 15}, "camera_lidar", "yaw and roll", "weak", "15 usable frames: record 30 or more", "weak"),
        ({"has_intensity": False}, "camera_lidar", "pitch", "weak", "the lidar has few rings", "yes"),
        ({"has_intensity": False, "rings": 64}, "camera_lidar", "pitch", "yes", "", "yes"),
        ({"doppler_problem": "odd"}, "lidar_radar", "yaw, x and y", "weak", "odd", "weak"),
        (
            {"frames": 0, "has_prior": False, "labels_share": 0.0}, "camera_lidar", "yaw and roll", "no",
            "0 usable synchronised frames; at least 10 are needed (", "no",
        ),
    ],
)  # fmt: skip
def test_what_is_lacking_costs_just_the_dof_that_need_it(changes, pair, dof, verdict, reason, answer):
    found, overall_answer = judge(**changes)
    assert (found[pair, dof].verdict, overall_answer) == (verdict, answer)
    assert "".join(found[pair, dof].reasons[:1]).startswith(reason)
    assert answer == "no" or found["lidar_radar", "yaw, x and y"].verdict != "no"


@settings(max_examples=40, deadline=None)
@given(st.floats(2, 35), st.sampled_from([None, 10.394, 40.0]), st.sampled_from([1, -1]), st.integers(0, 100))
def test_the_speed_of_the_car_shows_in_a_scan_even_where_doppler_wraps(speed, period, sign, seed):
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-0.9, 0.9, 400), rng.uniform(-0.1, 0.1, 400)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    range_rate = -sign * speed * directions[:, 0] + rng.normal(0, 0.05, 400)
    range_rate[:80] = rng.uniform(-20, 20, 80)  # traffic
    if period is not None:
        range_rate = (range_rate + period / 2) % period - period / 2
    found, share = doppler_speed(directions, range_rate, period)
    assert found == pytest.approx(sign * speed, abs=0.4)
    assert share > 0.7


def report_on(kit, tmp_path, drive, **fleet):
    config = kit.fleet(ingest={"min_lidar_points": 500}, **fleet)
    return check_logs([drive.mcap(tmp_path / "a.mcap")], config.rigs["default"], config)


def with_clouds(kit, frames, topic, columns, drive=None):
    """A drive with other clouds on a topic: `columns` makes those of a frame."""
    drive = drive or kit.Kit(frames=frames).drive()
    frame_id = "lidar" if topic == kit.LIDAR else "radar"
    return drive.each(topic, lambda i, at: drive.cloud(at, columns(i), frame_id=frame_id))


def test_a_complete_drive_is_fit_and_its_facts_are_right(kit, tmp_path):
    report = report_on(kit, tmp_path, kit.Kit(frames=40).drive())
    assert report.answer == "yes"
    # Its points lie anywhere, whatever their ring numbers say: no rows.
    assert report.evidence == Evidence(40, True, 1.0, 1.0, True, 0, 1.0, 1.0)
    assert (report.sync.sweeps, report.sync.moments) == (40, 40)
    assert report.sync.camera_median_ms == pytest.approx(1.0)
    assert report.sync.radar_median_ms == pytest.approx(2.0)
    assert report.frame_ids == {"camera": ["camera_optical"], "lidar": ["lidar"], "radar": ["radar"]}
    assert (report.has_point_time, report.has_odometry) == (True, False)
    rates = {t.role: t.rate_hz for t in report.topics}
    assert rates["lidar"] == pytest.approx(10.0)
    found = {(p.parent, p.child): p for p in report.rig.pairs}
    assert set(found) == set(FRAMES_OF_PAIR.values())
    assert all(p.is_edge and p.moments == 40 and p.verdicts for p in found.values())
    assert report.rig.reference == "lidar"
    assert json.loads(json.dumps(asdict(report)))["rig"]["pairs"][0]["kind"] == "camera_lidar"


@pytest.mark.parametrize(("role", "sensor"), [("LIDAR", "lidar"), ("RADAR", "radar"), ("IMAGE", "camera")])
def test_without_a_sensors_topic_its_pairs_alone_fail_and_nothing_else_is_said_to_be_missing(
    kit, tmp_path, role, sensor
):
    topic = getattr(kit, role)
    drive = kit.Kit(frames=12).drive()
    drive.messages = [("/mistyped", *m[1:]) if m[0] == topic else m for m in drive.messages]
    report = report_on(kit, tmp_path, drive)
    assert any(topic in line and "/mistyped" in line for line in report.advice)
    verdicts = report.verdicts
    others = [v for v in verdicts if sensor not in FRAMES_OF_PAIR[v.pair]]
    assert {v.pair for v in verdicts} == set(PAIRS)
    assert all(v.reasons[0].startswith("12 usable frames") for v in others if v.verdict != "no")
    assert any(v.verdict == "weak" for v in others)
    for found in (v for v in verdicts if sensor in FRAMES_OF_PAIR[v.pair]):
        assert found.verdict == "no"
        assert topic in found.reasons[0]
        assert "/mistyped" in found.reasons[0]
        assert found.reasons[0].endswith("(prior, labels and motion were therefore not checked)")
        assert found.reasons[1:] == []


def test_a_planar_radar_is_noticed(kit, tmp_path):
    planar = with_clouds(kit, 40, kit.RADAR, lambda i: {n: v for n, v in kit.radar(i).items() if n != "z"})
    report = report_on(kit, tmp_path, planar)
    assert (report.answer, report.evidence.elevation_share) == ("partly", 0.0)


@pytest.mark.parametrize(
    ("radar", "answer", "words"),
    [
        ({"doppler_field": "speed"}, "partly", "x, y, z, doppler, power"),
        ({"doppler_positive": "receding"}, "no", 'doppler_positive is probably "approaching"'),
        ({"doppler_period_mps": 2.0}, "weak", "doppler_period_mps = 2"),
    ],
)
def test_what_fleet_toml_has_wrong_of_a_radar_is_noticed_and_costs_its_pairs(
    kit, tmp_path, radar, answer, words
):
    report = report_on(kit, tmp_path, kit.Kit(frames=40).drive(), radar=radar)
    assert report.answer == answer
    assert words in "".join([report.evidence.doppler_problem, *report.problems])
    assert words != "x, y, z, doppler, power" or words in report.corrections[0]  # before the next check
    refused = {v.pair for v in report.verdicts if v.verdict == "no"}
    assert answer == "weak" or refused >= {"lidar_radar", "camera_radar"}


def test_a_camera_frame_that_is_not_optical_is_noticed(kit, tmp_path):
    drive = kit.Kit(frames=12).drive()
    level = [drive.transform(0, "base_link", f) for f in ("camera_optical", "lidar", "radar")]
    drive.replaced("/tf_static", 0, drive.tf(*level))
    assert any("optical" in line for line in report_on(kit, tmp_path, drive).advice)


def test_unusable_logs_are_a_no_and_missing_ones_a_mistake(kit, tmp_path):
    config = kit.fleet()
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    report = check_logs([tmp_path / "a.mcap"], config.rigs["default"], config)
    assert report.answer == "no"
    assert report.problems
    assert ["a.mcap: is not a log" in c for c in report.corrections] == [True]  # and no other cause
    with pytest.raises(ConfigError, match="no such file"):
        check_logs([tmp_path / "none.mcap"], config.rigs["default"], config)


def test_a_model_that_is_not_what_its_manifest_means_stops_the_check(tmp_path):
    (tmp_path / "model.onnx").write_bytes(b"another")
    (tmp_path / "m.toml").write_text(
        f'path = "model.onnx"\nsha256 = "{"0" * 64}"\ntask = "segment"\n[input]\nsize = [32, 32]\n'
        '[output]\nlayout = "logits"\nlabel_set = "cityscapes"\n'
    )
    text = fleet_toml("car-1")
    line = next(line for line in text.splitlines() if line.startswith("semantics"))
    onnx = 'semantics = { source = "onnx", segmenter = "m.toml", detector = "m.toml" }'
    (tmp_path / "fleet.toml").write_text(text.replace(line, onnx))
    with pytest.raises(ModelError, match=r"m\.toml.*sha256"):
        check(tmp_path / "fleet.toml", tmp_path / "log.mcap")


def scaled(columns, factor):
    return columns | {n: (factor * columns[n]).astype(np.float32) for n in "xyz"}


@pytest.mark.parametrize(
    ("sensor", "factor", "unit"), [("lidar", 1000, "millimetres"), ("radar", 100, "centimetres")]
)
def test_points_in_another_unit_are_named_with_the_unit_that_fits(
    kit, tmp_path, run_ingest, sensor, factor, unit
):
    make = getattr(kit, sensor)
    drive = with_clouds(kit, 12, getattr(kit, sensor.upper()), lambda i: scaled(make(i), factor))
    verdicts = report_on(kit, tmp_path, drive).verdicts
    for found in (v for v in verdicts if sensor in FRAMES_OF_PAIR[v.pair]):
        assert found.verdict == "no"
        assert f"{unit} fit" in found.reasons[0]
    result, _ = run_ingest(tmp_path / "a.mcap", fleet=kit.fleet(ingest={"min_lidar_points": 500}))
    assert result.rejected[f"without_{sensor}_{sensor}_points_in_another_unit"] == 12
    for other, of in (("LIDAR", kit.lidar), ("RADAR", kit.radar)):
        with_clouds(kit, 12, getattr(kit, other), lambda i, of=of: scaled(of(i), 1000), drive)
    result, _ = run_ingest(drive.mcap(tmp_path / "both.mcap"), name="both")
    assert (result.status, result.faults) == ("refused", ("unit",))


def street(i, turn=1.0):
    """Posts that lidar and radar both see, all of them ahead of the car; `turn` -1: as a sensor that looks back."""
    rng = np.random.default_rng(i)
    foot = np.repeat(rng.uniform((6, -15), (50, 15), (25, 2)), 32, axis=0)
    xyz = np.column_stack([foot, np.tile(np.linspace(-1.5, 2, 32), 25)])
    return (xyz * [turn, turn, 1]).astype(np.float32)


def lidar_street(kit, i, turn=1.0):
    xyz = street(i, turn)
    return kit.lidar(i) | dict(zip("xyz", xyz.T, strict=True))


def radar_street(i, turn=1.0, factor=1.0):
    """At 10 m/s ahead, wherever the radar looks; positive is approaching, as the kit's fleet.toml says."""
    # The kit mounts the radar 2.6 m ahead of the lidar, .1 m to its left and 1.3 m below.
    xyz = (street(i)[::13] - [2.6, 0.1, -1.3]) * [turn, turn, 1]
    doppler = factor * turn * 10 * xyz[:, 0] / np.linalg.norm(xyz, axis=1)
    columns = dict(zip("xyz", xyz.T, strict=True)) | {"doppler": doppler, "power": 0 * doppler + 30}
    return {n: v.astype(np.float32) for n, v in columns.items()}


def street_drive(kit, lidar_turn=1.0, **radar):
    drive = with_clouds(kit, 20, kit.RADAR, lambda i: radar_street(i, **radar))
    return with_clouds(kit, 20, kit.LIDAR, lambda i: lidar_street(kit, i, lidar_turn), drive)


@pytest.mark.parametrize(
    ("street", "doppler", "wrong"),
    [
        ({}, "", ""),
        ({"turn": -1.0}, "the radar points backwards", ""),
        ({"lidar_turn": -1.0}, "", "the lidar points backwards"),
        ({"factor": -1.0}, 'doppler_positive is probably "receding"', ""),
    ],
)
def test_a_sensor_that_looks_back_is_told_from_a_sign(kit, tmp_path, street, doppler, wrong):
    report = report_on(kit, tmp_path, street_drive(kit, **street))
    evidence = report.evidence
    assert doppler in evidence.doppler_problem
    assert wrong in "".join(evidence.wrong)
    assert not any("doppler_positive" in a for a in report.advice)  # the rig has a sign
    if not street:
        assert (evidence.doppler_problem, evidence.wrong) == ("", ())
    elif wrong:
        assert report.answer == "no"
    else:
        assert evidence.doppler_is_wrong


@pytest.mark.parametrize(
    ("odometry", "doppler", "words", "answer"),
    [
        (10.0, 1.0, "", "weak"),  # twenty frames
        (36.0, 1.0, "km/h for m/s fits the odometry", "no"),
        (-10.0, 1.0, "the other sign fits the odometry", "no"),
        (10.0, 3.6, "km/h for m/s fits the Doppler", "partly"),  # odometry moves camera and lidar
        (20.0, 1.0, "a scale is wrong", "no"),
    ],
)
def test_odometry_and_doppler_that_differ_by_a_unit_or_a_sign_are_named(
    kit, tmp_path, odometry, doppler, words, answer
):
    report = report_on(kit, tmp_path, street_drive(kit, factor=doppler).driven(odometry))
    evidence = report.evidence
    shown = "; ".join([evidence.doppler_problem, *evidence.wrong])
    assert words in shown
    assert bool(shown.strip("; ")) == bool(words)
    assert report.answer == answer
    of_radar = [v for v in report.verdicts if "radar" in v.pair]
    assert all(v.verdict == "no" for v in of_radar) == bool(words)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(-1.0, "the log confirms it"), (1.0, "the log shows the opposite"), (0.0, "does not determine it")],
)
def test_a_sign_that_nobody_wrote_down_is_said_with_what_the_log_shows(kit, tmp_path, factor, words):
    log = street_drive(kit, factor=factor).mcap(tmp_path / "a.mcap")
    config = kit.fleet(ingest={"min_lidar_points": 500})
    rig = config.rigs["default"]
    unsigned = rig.model_copy(update={"radars": {"radar": RadarTopics(points=rig.radar.points)}})
    [advice] = [a for a in check_logs([log], unsigned, config).advice if "doppler_positive" in a]
    assert words in advice


def test_of_many_sensors_edges_are_judged_by_name_and_a_silent_one_is_left_out(kit, tmp_path):
    config = kit.fleet(ingest={"min_lidar_points": 500})
    rig = config.rigs["default"]
    radars = {"ahead": rig.radar, "behind": RadarTopics(points="/behind/points")}
    rig = Rig.model_validate(
        {"cameras": {"front": rig.camera}, "lidars": {"top": rig.lidar}, "radars": radars}
    )
    report = check_logs([kit.Kit(frames=40).drive().mcap(tmp_path / "a.mcap")], rig, config)
    assert {v.pair for v in report.verdicts} == {"front-top", "front-ahead", "top-ahead"}
    assert report.rig.loose == ["behind"]
    assert any(a.startswith("/behind/points: no message") for a in report.advice)
    found = {(p.parent, p.child): p for p in report.rig.pairs}
    assert found["top", "behind"].why_not == "no data of behind"
    assert found["front", "top"].moments == 40
