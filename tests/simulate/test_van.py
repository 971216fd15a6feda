"""A rig of thirteen named sensors: what its log, its fleet.toml and its truth hold, and faults of one of them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.report.truth import read_truth
from pipeline.rig.se3 import inverse, log_so3
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.simulate.sensors.mounting import Mounting, mounting_of
from pipeline.simulate.sensors.rig_spec import CameraSpec, LidarSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.simulated_frame import Setup, frame_of, scene_of
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive

DAY = "2026-03-02"
VAN = rig_named("van")
CAMERAS, LIDARS, RADARS = ([s.name for s in VAN.of_kind(kind)] for kind in ("camera", "lidar", "radar"))
FAULTS = (
    "vehicle-1:0:corner_rr:missing:1@0.5,vehicle-1:0:rear:stuck:1,vehicle-1:0:left:intrinsics:0.02,"
    "vehicle-1:0:grille:stamp:0.03,vehicle-1:0:corner_fl:yaw:0.5@0.5,vehicle-1:0:nose:swap:1"
)


def small(sensor):
    """The sensor with an eighth of its pixels or beams, for time."""
    sheet = sensor.sheet
    if isinstance(sheet, CameraSpec):
        sheet = replace(sheet, width_px=sheet.width_px // 4, height_px=sheet.height_px // 4)
    elif isinstance(sheet, LidarSpec):
        sheet = replace(sheet, columns=sheet.columns // 4)
    return replace(sensor, sheet=sheet)


@pytest.fixture(scope="module")
def days(tmp_path_factory, read, the_log):
    """A good and a faulty day of two moments: folder, (topic, stamp, message) and truth of each."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.simulate.fleet.rig_named", lambda _: VAN.changed(small))
        for name, faults in (("good", ""), ("bad", FAULTS)):
            out = tmp_path_factory.mktemp(name)
            spec = FleetSpec(
                vehicles=1, days=1, frames=2, drives=1, rig="van", environments="urban",
                faults=parse_faults(faults, [DAY], VAN),
            )  # fmt: skip
            simulate_fleet(spec, out)
            truth = json.loads((out / "truth" / "vehicle-1" / f"{DAY}.json").read_text())
            found[name] = out, read(the_log(out)), truth
    return found


def sent(messages, topic):
    return [(stamp, message) for name, stamp, message in messages if name == topic]


def test_every_sensor_has_topics_of_its_own_in_the_log_and_in_fleet_toml(days):
    out, messages, _ = days["good"]
    rig = load_fleet(out / "fleet.toml").rig_of("vehicle-1")
    assert [*rig.cameras, *rig.lidars, *rig.radars] == [s.name for s in VAN.sensors]
    assert (rig.reference, rig.base) == ("top", "base_link")
    named = [c.image for c in rig.cameras.values()] + [c.info for c in rig.cameras.values()]
    named += [getattr(c.semantics, what) for c in rig.cameras.values() for what in ("labels", "detections")]
    named += [s.points for s in (*rig.lidars.values(), *rig.radars.values())]
    assert {topic for topic, _, _ in messages} == {*named, "/tf_static", rig.ego.odometry}
    frames = {m.header.frame_id for _, m in sent(messages, "/radar/corner_rl/points")}
    assert frames == {"corner_rl"}


def test_static_transforms_are_near_the_truth_of_every_sensor_but_not_the_truth(days):
    _, messages, truth = days["good"]
    ((_, tf),) = sent(messages, "/tf_static")
    assert {t.child_frame_id for t in tf.transforms} == {s.name for s in VAN.sensors}
    assert {t.header.frame_id for t in tf.transforms} == {"base_link"}
    for item in tf.transforms:
        at = item.transform.translation
        off = np.array([at.x, at.y, at.z]) - np.array(truth["T_base_sensor"][item.child_frame_id])[:3, 3]
        assert 1e-4 < np.linalg.norm(off) < 0.15


def test_every_sensor_but_the_reference_has_a_clock_of_its_own(days):
    _, messages, truth = days["good"]
    stamps = {n: [t for t, _ in sent(messages, f"/radar/{n}/points")] for n in RADARS}
    assert len({t for own in stamps.values() for t in own}) == sum(map(len, stamps.values()))
    assert all(len(own) == 3 for own in stamps.values())  # two moments, and one next nearest
    assert truth["dt_s"].pop("top") == 0
    assert len(set(truth["dt_s"].values())) == len(VAN.sensors) - 1


def test_a_sensor_measures_its_delay_before_its_stamp():
    rig = VAN.changed(small)
    drive, prompt = Drive(5, "highway", 8.0, 0), mounting_of(rig, 1, 0, 0)
    moment, scene = World(drive).moment(2.0), scene_of(drive)
    names = ("left", "grille", "corner_fl")

    def seen(delay_s, stamp_s):
        late = {n: replace(m, delay_s=delay_s) for n, m in prompt.sensors.items()}
        setup = Setup(rig, Mounting(late))
        return frame_of(moment, scene, setup, dict.fromkeys(names, stamp_s), np.random.default_rng(1))

    one, same, other = seen(0.0, 2.0), seen(0.125, 2.125), seen(-0.125, 2.125)
    for frame, is_same in ((same, True), (other, False)):
        assert (frame["left"].jpeg == one["left"].jpeg) is is_same
        for name in ("grille", "corner_fl"):
            assert np.array_equal(frame[name].xyz_m, one[name].xyz_m) is is_same


def test_a_fault_of_one_sensor_is_its_alone(days):
    _, good, truth = days["good"]
    _, bad, spoiled = days["bad"]
    assert len(sent(bad, "/radar/corner_rr/points")) < len(sent(good, "/radar/corner_rr/points"))
    assert sent(bad, "/radar/corner_rr/points")  # silent from half of the day on
    images = [bytes(m.data) for _, m in sent(bad, "/camera/rear/image/compressed")]
    assert len(images) > 1
    assert len(set(images)) == 1
    focal = [days[n][2]["cameras"]["left"]["K_logged"][0][0] for n in ("bad", "good")]
    assert focal[0] / focal[1] == pytest.approx(1.02)
    late = sent(bad, "/lidar/grille/points")[0][0] - sent(good, "/lidar/grille/points")[0][0]
    assert late * 1e-9 == pytest.approx(0.03, abs=2e-9)
    for topic in ("/camera/front/image/compressed", "/lidar/top/points"):
        for (t0, a), (t1, b) in zip(sent(good, topic), sent(bad, topic), strict=True):
            assert t0 == t1
            assert bytes(a.data) == bytes(b.data)
    for name in (s.name for s in VAN.sensors):
        T, T0 = (np.array(t["at_end_of_day"]["T_base_sensor"][name]) for t in (spoiled, truth))
        turn_deg = np.degrees(np.linalg.norm(log_so3(T[:3, :3] @ T0[:3, :3].T)))
        assert turn_deg == pytest.approx(0.5 if name == "corner_fl" else 0.0, abs=1e-6)


def test_a_mistaken_cable_sends_a_radar_s_points_under_its_neighbour_s_name(days):
    _, good, _ = days["good"]
    _, bad, _ = days["bad"]
    nose = sent(good, "/radar/nose/points")[0][1]
    elsewhere = sent(bad, "/radar/corner_fl/points")[0][1]
    assert bytes(nose.data) == bytes(elsewhere.data)
    assert elsewhere.header.frame_id == "corner_fl"


def test_vehicles_of_one_fleet_can_carry_other_sensors_than_the_rest(tmp_path):
    spec = FleetSpec(vehicles=2, days=1, frames=2, drives=1, own_rigs=(("vehicle-2", "duo"),), own_frames=1)
    simulate_fleet(spec, tmp_path)
    truths = [json.loads(p.read_text()) for p in sorted((tmp_path / "truth").glob("*/*.json"))]
    assert [t["drives"][0]["frames"] for t in truths] == [2, 1]
    fleet = load_fleet(tmp_path / "fleet.toml")
    assert fleet.rig_of("vehicle-1").sensors == ("camera", "lidar", "radar")
    assert fleet.rig_of("vehicle-2").sensors == ("front", "left", "top", "nose", "corner_fl")
    truth = read_truth(tmp_path / "truth")
    assert set(truth["vehicle-2", DAY]) == {"front", "left", "top", "nose", "corner_fl", "base"}
    of_three = json.loads((tmp_path / "truth" / "vehicle-1" / f"{DAY}.json").read_text())
    poses = truth["vehicle-1", DAY]
    T = inverse(poses["camera"]) @ poses["radar"]
    np.testing.assert_allclose(T, of_three["T_camera_radar"], atol=1e-12)


def test_a_fault_of_a_vehicle_that_lacks_the_sensor_is_refused_before_anything_is_written():
    faults = parse_faults("vehicle-1:0:corner_fl:yaw:1", [DAY], VAN)
    with pytest.raises(ConfigError, match="corner_fl"):
        FleetSpec(vehicles=2, days=1, rig="van", own_rigs=(("vehicle-1", "demo"),), faults=faults)


def test_cameras_of_a_car_without_a_lidar_have_an_image_some_metres_before_each_moment(
    tmp_path, read, the_log, monkeypatch
):
    rig = rig_named("no_lidar")
    monkeypatch.setattr("pipeline.simulate.fleet.rig_named", lambda _: rig.changed(small))
    simulate_fleet(
        FleetSpec(vehicles=1, days=1, frames=2, drives=1, rig="no_lidar", environments="highway"), tmp_path
    )
    assert load_fleet(tmp_path / "fleet.toml").rigs["no_lidar"].reference == "nose"
    messages = read(the_log(tmp_path))
    speed = np.mean([m.twist.twist.linear.x for topic, _, m in messages if topic == "/vehicle/odometry"])
    for name in ("front", "left", "right"):
        stamps = sorted(stamp for topic, stamp, _ in messages if topic == f"/camera/{name}/image/compressed")
        labels = sorted(stamp for topic, stamp, _ in messages if topic == f"/perception/{name}/labels")
        assert len(labels) >= 2
        for moment in labels[-1:]:
            before = max(stamp for stamp in stamps if stamp < moment and stamp not in labels)
            assert 1.5 < (moment - before) * 1e-9 * speed < 6.0
    assert rig_named("demo-pairs").image_pairs
    assert not rig_named("demo").image_pairs
