"""`boresight export` and `import` on a lake: what is not accepted is named, and exit codes tell it apart."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.export.calibration import FrameNames
from pipeline.export.formats import format_named
from pipeline.rig.day_prior import read_transforms
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.audit.fleet_records import vehicle_records
from tests.makers.calibrations import CAMERA, T_BASE_LIDAR, calibration
from tests.makers.commands import command
from tests.makers.lakes import write_observations
from tests.makers.table_rows import make_observation

BOTH = ["azimuth", "elevation"]
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
DAYS = [f"2026-03-0{k}" for k in (1, 2, 3, 4)]
HELD = {"status": "held", "reason": "halves disagree"}


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Days of vehicle v: the first accepted and certified, then radar elevation not certified, radar held, refused."""
    rng = np.random.default_rng(1)
    records = [replace(r, determined=BOTH) for r in vehicle_records("v", 4, rng, unobservable=(3,))]
    changed = {
        (DAYS[1], "lidar_radar"): {"determined": ["azimuth"], "reason": "elevation known to 0.4 deg"},
        (DAYS[2], "lidar_radar"): HELD | {"determined": []},
        (DAYS[2], "camera_radar"): HELD | {"determined": []},
    }
    refused = {"status": "refused", "reason": "12 frames", "determined": [],
               **dict.fromkeys((*POSE, "covariance"))}  # fmt: skip
    rows = [replace(r, **changed.get((r.day, r.pair), refused if r.day == DAYS[3] else {})) for r in records]
    lake = Lake.at(tmp_path_factory.mktemp("lake"))
    commit_records(lake, CALIBRATIONS, rows)
    row = make_observation(
        np.random.default_rng(2), nulls=True, camera_model=CAMERA.model, camera_K=CAMERA.K,
        camera_D=CAMERA.D, image_width_px=CAMERA.width_px, image_height_px=CAMERA.height_px,
    )  # fmt: skip
    write_observations(lake, Partition("v", DAYS[0]), [row], "k")
    return lake.root


@pytest.fixture
def export(lake, capsys):
    """The command, of vehicle v of the lake."""
    return lambda form, out, *more: command(
        capsys, "export", form, "--lake", lake, "--vehicle", "v", "--out", out, *more
    )


def test_an_accepted_day_goes_out_and_comes_back_as_a_prior(export, lake, tmp_path, capsys):
    told = export("kitti", tmp_path / "a.txt", "--day", DAYS[0])
    assert (told.code, told.summary["status"]) == (0, "done")
    assert told.summary["pairs"] == ["camera_lidar", "lidar_radar"]
    beside = tmp_path / "a.provenance.json"
    assert told.summary["outputs"] == [str(tmp_path / "a.txt"), str(beside)]
    side = json.loads(beside.read_text())["pairs"]["camera_lidar"]
    assert (side["work_key"], side["kept_at_prior"]) == ("v-0", ["tx"])
    assert command(capsys, "import", "kitti", tmp_path / "a.txt", "--out", tmp_path / "prior.json").code == 0
    # A prior's rotation is made orthogonal to the last bit when it is read; the file holds the record's own bits.
    held = json.loads((tmp_path / "prior.json").read_text())
    for r in read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord, vehicle="v", day=DAYS[0]):
        if r.pair != "camera_radar":
            assert held[f"T_{r.pair}"] == transform_of(r).tolist()
    read = read_transforms(tmp_path / "prior.json")
    np.testing.assert_allclose(read["camera_lidar"], held["T_camera_lidar"], atol=1e-14)


def test_a_direction_that_is_not_certified_is_named_in_the_file_on_stderr_and_in_the_summary(
    export, tmp_path
):
    told = export("urdf", tmp_path, "--day", DAYS[1])
    assert (told.code, told.summary["status"]) == (0, "done")
    assert told.summary["not_certified"] == {"lidar_radar": "elevation not certified"}
    in_words = "lidar_radar: used: roll, pitch, yaw, left, up; certified: azimuth; at the prior: forward"
    for text in (told.err, (tmp_path / "sensors.urdf").read_text()):
        assert in_words in text
        assert "lidar_radar: elevation known to 0.4 deg" in text


def test_a_held_pair_is_left_out_unless_forced_and_then_marked(export, tmp_path):
    kit = tmp_path / "sensor_kit_calibration.yaml"
    for force, pairs, words in (
        ([], ["camera_lidar"], "is left out: held: halves disagree"),
        (["--force"], ["camera_lidar", "lidar_radar"], "is HELD, check it before loading: halves disagree"),
    ):
        told = export("autoware", tmp_path, "--day", DAYS[2], *force)
        assert (told.code, told.summary["status"], told.summary["pairs"]) == (3, "partly", pairs)
        assert "halves disagree" in told.err
        assert f"WARNING: lidar_radar {words}" in kit.read_text()
        assert ("\n  radar:" in kit.read_text()) == bool(force)


def test_a_refused_day_writes_nothing_even_when_forced(export, tmp_path):
    told = export("opencv", tmp_path / "x.yaml", "--day", DAYS[3], "--force")
    assert (told.code, told.summary["status"], told.summary["outputs"]) == (4, "refused", [])
    assert "12 frames" in told.summary["not_certified"]["camera_lidar"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_a_day_that_certifies_only_what_no_file_is_made_of_has_exit_code_4(tmp_path, capsys, force):
    records = [
        replace(r, determined=BOTH, **({} if r.pair == "camera_radar" else HELD))
        for r in vehicle_records("v", 1, np.random.default_rng(1))
    ]
    commit_records(Lake.at(tmp_path / "lake"), CALIBRATIONS, records)
    call = ["export", "urdf", "--lake", tmp_path / "lake", "--vehicle", "v", "--day", DAYS[0], *force]
    told = command(capsys, *call, "--out", tmp_path / "out")
    assert (told.code, told.summary["status"]) == (4, "uncertified")
    assert told.summary["pairs"] == (["camera_lidar", "lidar_radar"] if force else [])


def test_the_car_hangs_on_its_own_base_where_a_file_says_where_the_lidar_sits(export, tmp_path, capsys):
    mount, file, log = tmp_path / "car.urdf", tmp_path / "o.urdf", tmp_path / "drive.mcap"
    mount.write_text(
        '<robot name="r"><link name="base_link"/><link name="top"/><joint name="j" type="fixed">'
        '<origin xyz="0.9 0 2" rpy="0 0 0"/><parent link="base_link"/><child link="top"/></joint></robot>'
    )
    log.write_bytes(format_named("tf-static").write(calibration(T_base_lidar=T_BASE_LIDAR))["tf_static.mcap"])
    named = ["--lidar-frame", "top", "--camera-frame", "front_optical"]

    def tree(*options):
        assert export("urdf", file, "--day", DAYS[0], *options).code == 0
        return format_named("urdf").tree({"o.urdf": file.read_bytes()})

    found = tree(*named, "--mount", f"urdf:{mount}")
    assert set(found.edges) == {"top", "front_optical", "radar"}
    np.testing.assert_allclose(found.lookup("base_link", "top")[:3, 3], [0.9, 0, 2])
    assert command(capsys, "import", "urdf", file, *named, "--out", tmp_path / "p.json").code == 0
    np.testing.assert_allclose(tree("--mount", f"log:{log}").lookup("base_link", "lidar"), T_BASE_LIDAR)
    same = json.loads(command(capsys, "compare", f"log:{log}", f"tf-static:{log}", "--json").out)["pairs"]
    assert {p["pair"] for p in same} >= {"camera_lidar", "lidar_radar"}
    assert max(abs(axis["change"]) for p in same for axis in p["axes"]) < 1e-9
    for wrong in (["--lidar-frame", "side", "--mount", f"urdf:{mount}"],
                  ["--base-frame", "map", "--mount", f"log:{log}"]):  # fmt: skip
        assert export("urdf", file, "--day", DAYS[0], *wrong).code == 2


OF_V = ["--lake", "{lake}", "--vehicle", "v"]
OF_DAY = [*OF_V, "--day", DAYS[0]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["kitti"], "needs --lake and --vehicle"),
        (["kitti", "--lake", "{lake}", "--vehicle", "w"], "the lake has no day of 'w'"),
        (["kitti", *OF_V, "--day", "2020-01-01"], "no record of v 2020-01-01"),
        (["kitti", *OF_V, "--day", "yesterday"], "is not a day"),
        (["urdf", *OF_DAY, "--lidar-frame", "a b"], "is not a valid frame name"),
        (["urdf", *OF_DAY, "--lidar-frame", "radar"], "must differ"),
        (["urdf", *OF_DAY, "--mount", "car.urdf"], "is not log:FILE or FORMAT:FILE"),
        (["urdf", *OF_DAY, "--mount", "urdf:none.urdf"], "cannot be read"),
        (["urdf", *OF_DAY, "--mount", "kitti:none"], "files have no frames of a car"),
        (["stl", *OF_V], "stl"),
    ],
)
def test_what_cannot_be_exported_is_a_usage_error_in_one_line(lake, tmp_path, capsys, arguments, words):
    given = [a.replace("{lake}", str(lake)) for a in arguments]
    told = command(capsys, "export", *given, "--out", tmp_path / "o")
    assert told.code == 2
    assert words in told.summary["reason"]
    assert not (tmp_path / "o").exists()


def test_a_prior_takes_from_another_file_what_the_calibration_lacks(tmp_path, capsys):
    (tmp_path / "calib.txt").write_text("Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0.5 1 0 0 -1\n")
    known = {"T_camera_lidar": np.eye(4).tolist(), "T_lidar_radar": np.diag([-1.0, -1, 1, 1]).tolist()}
    (tmp_path / "old.json").write_text(json.dumps(known))
    call = ["import", "kitti", tmp_path / "calib.txt", "--out", tmp_path / "new.json"]
    told = command(capsys, *call)
    assert told.code == 2
    assert "T_lidar_radar: missing" in told.summary["reason"]
    assert command(capsys, *call, "--also", tmp_path / "old.json").code == 0
    made = read_transforms(tmp_path / "new.json")
    assert (made["camera_lidar"][1, 3], made["lidar_radar"][0, 0]) == (0.5, -1)


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


def test_autoware_s_own_kit_keeps_its_comments_its_other_sensors_and_its_lidar(export, lake, tmp_path):
    kit = tmp_path / "sensor_kit_calibration.yaml"
    kit.write_text(KIT)
    update = ["--day", DAYS[0], "--update", kit]
    names = ["--camera-frame", "front/camera_link", "--lidar-frame", "top_base_link"]
    told = export("autoware", kit, *update, *names)
    assert (told.code, len(told.summary["outputs"])) == (0, 2)
    before, after = KIT.splitlines(), kit.read_text().splitlines()
    changed = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a.split() != b.split()]
    assert set(changed) <= set(range(3, 9))  # the six numbers of the camera
    side = json.loads((tmp_path / "sensor_kit_calibration.provenance.json").read_text())
    assert side["updated"] == ["front/camera_link"]
    frames = FrameNames({"camera": "front/camera_link", "lidar": "top_base_link"})
    found = format_named("autoware").pairs({"kit": kit.read_bytes()}, frames)
    records = read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord, vehicle="v", day=DAYS[0])
    [wanted] = [transform_of(r) for r in records if r.pair == "camera_lidar"]
    np.testing.assert_allclose(found["camera_lidar"], wanted, atol=1e-12)
    for form, bad, words in (
        ("autoware", [*names[:2], "--lidar-frame", "side"], "sensor_kit_base_link.side: missing"),
        ("autoware", ["--camera-frame", "c", *names[2:]], "none is in sensor_kit_base_link"),
        ("urdf", names, "does not support --update"),
    ):
        told = export(form, kit, *update, *bad)
        assert told.code == 2
        assert words in told.summary["reason"]
