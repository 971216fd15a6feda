"""`boresight export` and `import` on a lake: what is not accepted is named, and exit codes tell it apart."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jobs.cli import main
from pipeline.export.calibration import FrameNames
from pipeline.export.formats import format_named
from pipeline.rig.prior_file import read_transforms
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.states import STATES, StateRow
from tests.audit.fleet_records import vehicle_records
from tests.makers.calibrations import CAMERA, T_BASE_LIDAR, calibration
from tests.makers.lakes import write_observations
from tests.makers.table_rows import make_observation

BOTH = ["azimuth", "elevation"]


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Days of vehicle v: the first accepted and certified, then radar elevation not certified, radar held, refused."""
    folder = tmp_path_factory.mktemp("lake")
    records = [
        replace(r, determined=BOTH)
        for r in vehicle_records("v", 4, np.random.default_rng(1), unobservable=(3,))
    ]
    days = sorted({r.day for r in records})
    changed = {
        (days[1], "lidar_radar"): {"determined": ["azimuth"], "reason": "elevation known to 0.4 deg"},
        (days[2], "lidar_radar"): {"status": "held", "reason": "halves disagree", "determined": []},
        (days[2], "camera_radar"): {
            "status": "held",
            "reason": "lidar-radar: halves disagree",
            "determined": [],
        },
    }
    nothing = dict.fromkeys(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m", "covariance"))
    refused = {"status": "refused", "reason": "12 frames", "determined": [], **nothing}
    rows = [replace(r, **changed.get((r.day, r.pair), refused if r.day == days[3] else {})) for r in records]
    tables = Lake.at(folder)
    commit_records(tables, CALIBRATIONS, rows)
    first = [r for r in rows if r.day == days[0]]
    shared = (
        "vehicle",
        "method",
        "pair",
        "parent_frame",
        "child_frame",
        "qw",
        "qx",
        "qy",
        "qz",
        "tx_m",
        "ty_m",
        "tz_m",
    )
    states = [
        StateRow(
            **{name: getattr(r, name) for name in shared}, day=days[3], status="current", reason="",
            work_key="state", covariance=r.covariance, common_covariance=0.5 * r.covariance, observable=[True] * 6,
            determined=BOTH, days=[days[0]],
        )
        for r in first
    ]  # fmt: skip
    commit_records(tables, STATES, states)
    row = make_observation(
        np.random.default_rng(2), nulls=True, camera_model=CAMERA.model, camera_K=CAMERA.K,
        camera_D=CAMERA.D, image_width_px=CAMERA.width_px, image_height_px=CAMERA.height_px,
    )  # fmt: skip
    write_observations(tables, Partition("v", days[0]), [row], "k")
    return folder, days


def run(capsys, *arguments):
    """Exit code, summary, and what stderr says."""
    code = main([str(a) for a in arguments])
    said = capsys.readouterr()
    return code, json.loads(said.out.splitlines()[-1]), said.err


def test_an_accepted_day_and_a_state_go_out_and_come_back_as_a_prior(lake, tmp_path, capsys):
    folder, days = lake
    of_v = ["--lake", folder, "--vehicle", "v"]
    code, summary, _ = run(capsys, "export", "kitti", *of_v, "--day", days[0], "--out", tmp_path / "a.txt")
    assert (code, summary["status"], summary["pairs"]) == (0, "done", ["camera_lidar", "lidar_radar"])
    assert [tmp_path / n for n in ("a.txt", "a.provenance.json")] == [
        tmp_path / o for o in summary["outputs"]
    ]
    said = json.loads((tmp_path / "a.provenance.json").read_text())
    assert said["pairs"]["camera_lidar"]["work_key"] == "v-0"
    assert said["pairs"]["camera_lidar"]["kept_at_prior"] == ["tx"]
    code, summary, _ = run(capsys, "import", "kitti", tmp_path / "a.txt", "--out", tmp_path / "prior.json")
    assert code == 0
    # A prior's rotation is made orthogonal to the last bit when it is read; the file holds the record's own bits.
    held = json.loads((tmp_path / "prior.json").read_text())
    for r in read_records(Lake.at(folder), CALIBRATIONS, CalibrationRecord, vehicle="v", day=days[0]):
        if r.pair != "camera_radar":
            assert held[f"T_{r.pair}"] == transform_of(r).tolist()
    np.testing.assert_allclose(
        read_transforms(tmp_path / "prior.json")["camera_lidar"], held["T_camera_lidar"], atol=1e-14
    )
    code, summary, _ = run(capsys, "export", "ros2", *of_v, "--out", tmp_path / "ros")
    assert (code, summary["source"]) == (0, f"state of {days[3]}")
    assert (tmp_path / "ros" / "static_transforms.launch.py").is_file()


def test_a_direction_that_is_not_certified_is_named_in_the_file_on_stderr_and_in_the_summary(
    lake, tmp_path, capsys
):
    folder, days = lake
    code, summary, said = run(
        capsys, "export", "urdf", "--lake", folder, "--vehicle", "v", "--day", days[1], "--out", tmp_path
    )
    assert (code, summary["status"]) == (0, "done")
    assert summary["not_certified"] == {"lidar_radar": "elevation not certified"}
    for text in (said, (tmp_path / "sensors.urdf").read_text()):
        assert (
            "lidar_radar: used: roll, pitch, yaw, left, up; certified: azimuth; at the prior: forward" in text
        )
        assert "lidar_radar: elevation known to 0.4 deg" in text


def test_a_held_pair_is_left_out_unless_forced_and_then_marked(lake, tmp_path, capsys):
    folder, days = lake
    call = ["export", "autoware", "--lake", folder, "--vehicle", "v", "--day", days[2], "--out", tmp_path]
    code, summary, said = run(capsys, *call)
    assert (code, summary["status"], summary["pairs"]) == (3, "partly", ["camera_lidar"])
    assert "halves disagree" in said
    kit = tmp_path / "sensor_kit_calibration.yaml"
    assert "WARNING: lidar_radar is left out: held: halves disagree" in kit.read_text()
    assert "\n  radar:" not in kit.read_text()
    code, summary, _ = run(capsys, *call, "--force")
    assert (code, summary["pairs"]) == (3, ["camera_lidar", "lidar_radar"])
    assert "WARNING: lidar_radar is HELD, check it before loading: halves disagree" in kit.read_text()
    assert "\n  radar:" in kit.read_text()


def test_a_refused_day_writes_nothing_even_when_forced(lake, tmp_path, capsys):
    folder, days = lake
    call = [
        "export",
        "opencv",
        "--lake",
        folder,
        "--vehicle",
        "v",
        "--day",
        days[3],
        "--out",
        tmp_path / "x.yaml",
    ]
    code, summary, _ = run(capsys, *call, "--force")
    assert (code, summary["status"], summary["outputs"]) == (4, "refused", [])
    assert "12 frames" in summary["not_certified"]["camera_lidar"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_a_day_that_certifies_only_what_no_file_is_made_of_has_exit_code_4(tmp_path, capsys, force):
    held = {"status": "held", "reason": "halves disagree"}
    records = [
        replace(r, determined=BOTH, **({} if r.pair == "camera_radar" else held))
        for r in vehicle_records("v", 1, np.random.default_rng(1))
    ]
    commit_records(Lake.at(tmp_path / "lake"), CALIBRATIONS, records)
    call = ["export", "urdf", "--lake", tmp_path / "lake", "--vehicle", "v", "--day", records[0].day, *force]
    code, summary, _ = run(capsys, *call, "--out", tmp_path / "out")
    assert (code, summary["status"]) == (4, "uncertified")
    assert summary["pairs"] == (["camera_lidar", "lidar_radar"] if force else [])


def test_the_car_hangs_on_its_own_base_where_a_file_says_where_the_lidar_sits(lake, tmp_path, capsys):
    folder, days = lake
    mount = tmp_path / "car.urdf"
    mount.write_text(
        '<robot name="r"><link name="base_link"/><link name="top"/><joint name="j" type="fixed">'
        '<origin xyz="0.9 0 2" rpy="0 0 0"/><parent link="base_link"/><child link="top"/></joint></robot>'
    )
    named = ["--lidar-frame", "top", "--camera-frame", "front_optical", "--mount", f"urdf:{mount}"]
    file = tmp_path / "o.urdf"
    call = ["export", "urdf", "--lake", folder, "--vehicle", "v", "--day", days[0], "--out", file]
    assert run(capsys, *call, *named)[0] == 0
    tree = format_named("urdf").tree({"o.urdf": file.read_bytes()})
    assert set(tree.edges) == {"top", "front_optical", "radar"}
    np.testing.assert_allclose(tree.lookup("base_link", "top")[:3, 3], [0.9, 0, 2])
    assert run(capsys, "import", "urdf", file, *named[:4], "--out", tmp_path / "p.json")[0] == 0
    assert run(capsys, *call, "--lidar-frame", "side", "--mount", f"urdf:{mount}")[0] == 2
    log = tmp_path / "drive.mcap"
    log.write_bytes(format_named("tf-static").write(calibration(T_base_lidar=T_BASE_LIDAR))["tf_static.mcap"])
    assert run(capsys, *call, "--mount", f"log:{log}")[0] == 0
    tree = format_named("urdf").tree({"o.urdf": file.read_bytes()})
    np.testing.assert_allclose(tree.lookup("base_link", "lidar"), T_BASE_LIDAR)
    assert run(capsys, *call, "--base-frame", "map", "--mount", f"log:{log}")[0] == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["kitti"], "needs --lake and --vehicle"),
        (["kitti", "--lake", "{lake}", "--vehicle", "w"], "no state of w by joint"),
        (["kitti", "--lake", "{lake}", "--vehicle", "v", "--day", "2020-01-01"], "no record of v 2020-01-01"),
        (["kitti", "--lake", "{lake}", "--vehicle", "v", "--day", "yesterday"], "is not a day"),
        (["urdf", "--lake", "{lake}", "--vehicle", "v", "--lidar-frame", "a b"], "is not a valid frame name"),
        (["urdf", "--lake", "{lake}", "--vehicle", "v", "--lidar-frame", "radar"], "must differ"),
        (
            ["urdf", "--lake", "{lake}", "--vehicle", "v", "--mount", "car.urdf"],
            "is not log:FILE or FORMAT:FILE",
        ),
        (["urdf", "--lake", "{lake}", "--vehicle", "v", "--mount", "urdf:none.urdf"], "cannot be read"),
        (
            ["urdf", "--lake", "{lake}", "--vehicle", "v", "--mount", "kitti:none"],
            "files have no frames of a car",
        ),
        (["stl", "--lake", "{lake}", "--vehicle", "v"], "stl"),
    ],
)
def test_what_cannot_be_exported_is_a_usage_error_in_one_line(lake, tmp_path, capsys, arguments, words):
    given = [str(a).replace("{lake}", str(lake[0])) for a in arguments]
    code, summary, _ = run(capsys, "export", *given, "--out", tmp_path / "o")
    assert code == 2
    assert words in summary["reason"]
    assert not (tmp_path / "o").exists()


def test_a_prior_takes_from_another_file_what_the_calibration_lacks(tmp_path, capsys):
    (tmp_path / "calib.txt").write_text("Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1\n")
    known = {"T_camera_lidar": np.eye(4).tolist(), "T_lidar_radar": np.diag([-1.0, -1, 1, 1]).tolist()}
    (tmp_path / "old.json").write_text(json.dumps(known))
    call = ["import", "kitti", tmp_path / "calib.txt", "--out", tmp_path / "new.json"]
    code, summary, _ = run(capsys, *call)
    assert code == 2
    assert "T_lidar_radar: missing" in summary["reason"]
    assert run(capsys, *call, "--also", tmp_path / "old.json")[0] == 0
    made = read_transforms(tmp_path / "new.json")
    assert made["camera_lidar"][1, 3] == 0.5
    assert made["lidar_radar"][0, 0] == -1


KIT = """# kit of the red car
sensor_kit_base_link:
  front/camera_link:   # Design Value
    x: 0.5
    y: 0.0
    z: 0.2
    roll: 0.0
    pitch: 0.0
    yaw: 0.0
  top_base_link: {x: 0.0, y: 0.0, z: 0.1, roll: 0.0, pitch: 0.0, yaw: 1.5}   # measured
  gnss_link: {x: -0.1, y: 0.0, z: -0.2, roll: 0.0, pitch: 0.0, yaw: 0.0}
"""


def test_autoware_s_own_kit_keeps_its_comments_its_other_sensors_and_its_lidar(lake, tmp_path, capsys):
    folder, days = lake
    kit = tmp_path / "sensor_kit_calibration.yaml"
    kit.write_text(KIT)
    of_v = ["--lake", folder, "--vehicle", "v", "--day", days[0], "--update", kit, "--out", kit]
    names = ["--camera-frame", "front/camera_link", "--lidar-frame", "top_base_link"]
    code, summary, _ = run(capsys, "export", "autoware", *of_v, *names)
    assert (code, len(summary["outputs"])) == (0, 2)
    before, after = KIT.splitlines(), kit.read_text().splitlines()
    changed = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a.split() != b.split()]
    assert set(changed) <= set(range(3, 9))  # the six numbers of the camera
    side = json.loads((tmp_path / "sensor_kit_calibration.provenance.json").read_text())
    assert side["updated"] == ["front/camera_link"]
    found = format_named("autoware").pairs(
        {"kit": kit.read_bytes()}, FrameNames("front/camera_link", "top_base_link")
    )
    records = read_records(Lake.at(folder), CALIBRATIONS, CalibrationRecord, vehicle="v", day=days[0])
    [wanted] = [transform_of(r) for r in records if r.pair == "camera_lidar"]
    np.testing.assert_allclose(found["camera_lidar"], wanted, atol=1e-12)
    for form, bad, words in (
        ("autoware", [*names[:2], "--lidar-frame", "side"], "sensor_kit_base_link.side: missing"),
        ("autoware", ["--camera-frame", "c", *names[2:]], "none is in sensor_kit_base_link"),
        ("urdf", names, "does not support --update"),
    ):
        code, summary, _ = run(capsys, "export", form, *of_v, *bad)
        assert code == 2
        assert words in summary["reason"]
