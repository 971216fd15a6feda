"""Rigs and vehicles of fleet.toml, what is refused and why; the prior of a rig, from logs or a file."""

import json
from itertools import product

import numpy as np
import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError, SolveError
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.prior import from_rows, moved, star_of, to_rows
from pipeline.rig.se3 import adjoint, exp_se3, inverse, log_so3

VAN = """
[fleet]
name = "vans"
[rigs.van]
reference = "top"
base = "base_link"
[rigs.van.cameras.front]
image = "/front/image"
info = "/front/info"
semantics = { source = "topics", labels = "/front/labels", detections = "/front/detections" }
[rigs.van.cameras.left]
image = "/left/image"
info = "/left/info"
[rigs.van.lidars.top]
points = "/top/points"
[rigs.van.lidars.nose]
points = "/nose/points"
[rigs.van.radars.corner_fl]
points = "/fl/points"
prior = { rotation_sigma_deg = 4.0 }
[rigs.van.radars.corner_rr]
points = "/rr/points"
[vehicles."*"]
rig = "van"
"""


def load(tmp_path, text):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_a_rig_knows_its_sensors_by_name_and_in_the_order_of_the_file(tmp_path):
    rig = load(tmp_path, VAN).rigs["van"]
    assert rig.sensors == ("front", "left", "top", "nose", "corner_fl", "corner_rr")
    assert [(n.name, n.kind) for n in rig.nodes][-3:] == [
        ("corner_fl", "radar"), ("corner_rr", "radar"), ("base", "base"),
    ]  # fmt: skip
    assert (rig.cameras["left"].semantics, rig.lidars["nose"].points) == (None, "/nose/points")
    assert rig.named_edges is None
    own, rigs = rig.prior_of("corner_fl"), rig.prior_of("corner_rr")
    assert (own.rotation_sigma_deg, rigs.rotation_sigma_deg) == (4.0, 2.0)
    assert own.translation_sigma_m == rigs.translation_sigma_m == 0.05


def test_who_thinks_in_three_sensors_is_told_where_there_are_more(tmp_path):
    rig = load(tmp_path, VAN).rigs["van"]
    with pytest.raises(ConfigError, match=r"cameras: .*front, left"):
        _ = rig.camera
    with pytest.raises(
        ConfigError, match=r"rigs\.\*\.three: training takes one camera.*front, left, top.*three ="
    ):
        rig.one_of_each("training")
    named = rig.model_copy(update={"three": ("left", "top", "corner_fl")})
    assert named.one_of_each("training") == {"camera": "left", "lidar": "top", "radar": "corner_fl"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("lidars.nose", "lidars.front"), "two sensors are called front"),
        (("lidars.nose", "lidar"), "both lidar and lidars"),
        (("lidars.nose", "lidars.base"), "lidars.base: base is the name of another kind"),
        (("lidars.nose", "lidars.radar"), "lidars.radar: radar is the name of another kind"),
        (("lidars.nose", 'lidars."a/b"'), "letters, digits and _"),
        (("/nose/points", "/fl/points"), "/fl/points (points of nose and points of corner_fl)"),
        (("/left/info", "/front/info"), "/front/info (info of front and info of left)"),
        (('reference = "top"', 'reference = "roof"'), "reference = 'roof' is no sensor"),
        (('reference = "top"', 'reference = "base"'), "reference = 'base' is no sensor"),
        (('reference = "top"', 'reference = ["top", "nose"]'), "van.reference: the reference is one sensor"),
        (('reference = "top"', 'reference = "corner_fl"'), "corner_fl is the reference"),
        (('base = "base_link"', 'edges = [["front", "roof"]]'), "[front, roof]: the rig has front, left, top"),
        (('base = "base_link"', 'edges = [["top", "top"]]'), "[top, top]: an edge joins two sensors"),
        (('base = "base_link"', 'edges = [["front", "left"]]'), "cannot be calibrated against each other"),
        (('base = "base_link"', 'edges = [["top", "base"]]'), "no base (set base ="),
        (('base = "base_link"', 'edges = [["top", "left"], ["left", "top"]]'), "[left, top] occurs twice"),
        (('base = "base_link"', "edges = []"), "edges is empty"),
        (('base = "base_link"', 'three = ["front", "top", "nose"]'), "three = [front, top, nose]: name a camera"),
        (('base = "base_link"', 'three = ["front", "top"]'), "van.three"),
        (('base = "base_link"', 'base = ""'), "van.base"),
        (('base = "base_link"', "road_z_m = -0.3"), "road_z_m needs the vehicle frame"),
        (('points = "/top/points"', 'points = "/top/points"\nheight_m = 1.8'), "height_m and height_sigma_m go"),
        (('"/nose/points"', '"points"'), "rigs.van.lidars.nose.points"),
    ],
)  # fmt: skip
def test_a_rig_that_cannot_be_right_is_refused_by_what_is_wrong_with_it(change, said, tmp_path):
    assert change[0] in VAN
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, VAN.replace(*change, 1))
    assert said in str(caught.value)
    assert "fleet.toml: rigs.van" in str(caught.value)


@pytest.mark.parametrize(
    ("sensors", "is_enough"),
    [
        (("cameras", "lidars"), True), (("lidars", "lidars"), True), (("lidars",), False),
        (("cameras", "cameras"), False), (("radars", "radars"), False), ((), False),
    ],
)  # fmt: skip
def test_a_rig_that_can_have_no_edge_is_refused(sensors, is_enough, tmp_path):
    topics = {"cameras": 'image = "/{0}"\ninfo = "/i{0}"\n'}
    tables = [
        f"[rigs.a.{k}.s{i}]\n" + topics.get(k, 'points = "/{0}"\n').format(i) for i, k in enumerate(sensors)
    ]
    text = f'[fleet]\nname = "f"\n[rigs.a]\n{"".join(tables)}'
    if is_enough:
        assert len(load(tmp_path, text).rigs["a"].nodes) == 2
    else:
        with pytest.raises(ConfigError, match="a calibration needs two of camera, lidar and radar"):
            load(tmp_path, text)


def test_a_vehicle_is_known_by_name_then_by_the_longest_pattern(tmp_path):
    rigs = "".join(
        f'[rigs.{name}.lidar]\npoints = "/{name}/lidar"\n[rigs.{name}.radar]\npoints = "/radar"\n'
        for name in ("any", "taxi", "odd")
    )
    fleet = load(
        tmp_path,
        f'[fleet]\nname = "f"\n{rigs}[vehicles."*"]\nrig = "any"\n[vehicles."taxi-??"]\nrig = "taxi"\n'
        '[vehicles.taxi-13]\nrig = "odd"\n',
    )
    asked = ("van-1", "taxi-12", "taxi-13", "taxi-123")
    assert [fleet.vehicle(v).rig for v in asked] == ["any", "taxi", "odd", "any"]
    assert fleet.named_vehicles == ("taxi-13",)
    narrow = fleet.model_copy(update={"vehicles": {k: v for k, v in fleet.vehicles.items() if k != "*"}})
    assert [narrow.knows(v) for v in asked] == [False, True, True, False]
    with pytest.raises(ConfigError, match="unknown vehicle"):
        narrow.rig_of("van-1")


NAMES = ("front", "left", "top", "nose", "corner_fl", "corner_rr", "base")


def poses(seed=0):
    """T_base_sensor of the van's sensors."""
    rng = np.random.default_rng(seed)
    return {name: exp_se3(rng.normal(0, 1, 6)) for name in NAMES}


def prior_of(tmp_path, text=VAN, lost=()):
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    fleet = load_fleet(path)
    rig, T = next(iter(fleet.rigs.values())), poses()

    def chain(a, b):
        return None if (a in lost) != (b in lost) else inverse(T[a]) @ T[b]

    rows = json.loads(json.dumps(to_rows([star_of(rig.nodes, chain)])))
    return rig, rig_prior(rows, fleet, rig), T


def test_poses_of_all_sensors_come_back_through_the_manifest(tmp_path):
    _, prior, T = prior_of(tmp_path)
    known = prior.extrinsics()
    assert (known.reference.name, known.order) == ("top", tuple(n for n in NAMES if n != "top"))
    for a, b in product(NAMES, repeat=2):
        np.testing.assert_allclose(known.between(a, b), inverse(T[a]) @ T[b], atol=1e-9)
        np.testing.assert_allclose(prior.between(a, b), inverse(T[a]) @ T[b], atol=1e-9)


def test_the_reference_is_mounted_with_a_tolerance_of_its_own_that_all_poses_in_it_share(tmp_path):
    _, prior, T = prior_of(tmp_path)
    known = prior.extrinsics()
    own = np.diag([np.radians(2.0) ** 2] * 3 + [0.05**2] * 3)
    np.testing.assert_allclose(known.covariance_between("top", "base"), own, atol=1e-12)
    A = adjoint(inverse(T["top"]) @ T["left"])
    both = own + A @ known.covariance_between("left", "base") @ A.T
    np.testing.assert_allclose(known.covariance_between("top", "left"), both, atol=1e-12)
    assert prior.sigmas_between("top", "left") == pytest.approx(
        (np.radians(2 * np.sqrt(2)), 0.05 * np.sqrt(2))
    )
    assert prior.sigmas_between("left", "base") == pytest.approx((np.radians(2), 0.05))


def test_sensors_that_no_chain_reaches_are_named_and_know_each_other(tmp_path):
    _, prior, T = prior_of(tmp_path, lost=("corner_rr", "nose"))
    assert [n.name for n in prior.untied] == ["nose", "corner_rr"]
    assert prior.between("top", "nose") is None
    np.testing.assert_allclose(
        prior.between("nose", "corner_rr"), inverse(T["nose"]) @ T["corner_rr"], atol=1e-9
    )
    assert set(prior.extrinsics().T) == set(NAMES) - {"nose", "corner_rr"}
    shaken = moved(prior, 0.03, 0.1, seed=1)
    assert np.array_equal(shaken.between("nose", "corner_rr"), prior.between("nose", "corner_rr"))


def test_a_prior_that_changes_over_the_day_is_refused():
    T = {("top", "nose"): np.eye(4)}
    other = {("top", "nose"): exp_se3(np.array([0, 0, 1e-3, 0, 0, 0]))}
    assert len(to_rows([T, T])) == 1
    with pytest.raises(SolveError, match="top_nose changes over the day"):
        from_rows(to_rows([T, other]))


def test_no_sensor_but_the_reference_stays_where_it_was_and_all_move_by_as_much(tmp_path):
    _, prior, _ = prior_of(tmp_path)
    before, after = prior.extrinsics().T, moved(prior, np.radians(3), 0.1, seed=4)
    for name, T in after.extrinsics().T.items():
        turn = np.degrees(np.linalg.norm(log_so3(T[:3, :3] @ before[name][:3, :3].T)))
        shift = np.linalg.norm(T[:3, 3] - before[name][:3, 3])
        assert (turn, shift) == pytest.approx((0, 0) if name == "top" else (3, 0.1), abs=1e-9)
    assert after.sigmas["front"] == (np.radians(3), 0.1)
    assert after.sigmas["corner_fl"] == (np.radians(4), 0.1)


def test_a_prior_file_says_where_every_sensor_is(tmp_path):
    path = tmp_path / "prior.json"
    text = VAN + '[rigs.van.prior]\nsource = "file"\nfile = "prior.json"\n'
    T = poses()
    given = {"reference": "top", "T": {n: (inverse(T["top"]) @ T[n]).tolist() for n in NAMES if n != "top"}}
    path.write_text(json.dumps(given))
    _, prior, _ = prior_of(tmp_path, text)
    np.testing.assert_allclose(prior.between("left", "base"), inverse(T["left"]) @ T["base"], atol=1e-9)
    wrong = [
        (given | {"reference": "roof"}, "reference: 'roof' is none of front"),
        (given | {"T": {k: v for k, v in given["T"].items() if k != "nose"}}, "lacks nose"),
        (given | {"T": given["T"] | {"roof": np.eye(4).tolist()}}, "has roof, not in the rig"),
        (given | {"T": given["T"] | {"top": (2 * np.eye(4)).tolist()}}, "T.top"),
        (given | {"T": given["T"] | {"top": T["top"].tolist()}}, "the reference's own pose"),
        (given | {"T": given["T"] | {"nose": [[1]]}}, "T.nose: is no 4x4 matrix"),
        ({"T_camera_lidar": np.eye(4).tolist()}, '{"reference": "top", "T": {...}}'),
    ]
    for content, said in wrong:
        path.write_text(json.dumps(content))
        with pytest.raises(ConfigError) as caught:
            prior_of(tmp_path, text)
        assert said in str(caught.value)
        assert "prior.json" in str(caught.value)
