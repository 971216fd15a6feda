import pytest

from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError

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
        (
            ('base = "base_link"', 'edges = [["front", "roof"]]'),
            "[front, roof]: the rig has front, left, top",
        ),
        (('base = "base_link"', 'edges = [["top", "top"]]'), "[top, top]: an edge joins two sensors"),
        (('base = "base_link"', 'edges = [["front", "left"]]'), "cannot be calibrated against each other"),
        (('base = "base_link"', 'edges = [["top", "base"]]'), "no base (set base ="),
        (('base = "base_link"', 'edges = [["top", "left"], ["left", "top"]]'), "[left, top] occurs twice"),
        (('base = "base_link"', "edges = []"), "edges is empty"),
        (
            ('base = "base_link"', 'three = ["front", "top", "nose"]'),
            "three = [front, top, nose]: name a camera",
        ),
        (('base = "base_link"', 'three = ["front", "top"]'), "van.three"),
        (('base = "base_link"', 'base = ""'), "van.base"),
        (('base = "base_link"', "road_z_m = -0.3"), "road_z_m needs the vehicle frame"),
        (
            ('points = "/top/points"', 'points = "/top/points"\nheight_m = 1.8'),
            "height_m and height_sigma_m go",
        ),
        (('"/nose/points"', '"points"'), "rigs.van.lidars.nose.points"),
    ],
)
def test_a_rig_that_cannot_be_right_is_refused_by_what_is_wrong_with_it(change, said, tmp_path):
    assert change[0] in VAN
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, VAN.replace(*change, 1))
    assert said in str(caught.value)
    assert "fleet.toml: rigs.van" in str(caught.value)


@pytest.mark.parametrize(
    ("sensors", "is_enough"),
    [
        (("cameras", "lidars"), True),
        (("lidars", "lidars"), True),
        (("lidars",), False),
        (("cameras", "cameras"), False),
        (("radars", "radars"), False),
        ((), False),
    ],
)
def test_a_rig_that_can_have_no_edge_is_refused(sensors, is_enough, tmp_path):
    topics = [
        f"[rigs.a.{kind}.s{i}]\n"
        + (f'image = "/{i}"\ninfo = "/i{i}"\n' if kind == "cameras" else f'points = "/{i}"\n')
        for i, kind in enumerate(sensors)
    ]
    text = f'[fleet]\nname = "f"\n[rigs.a]\n{"".join(topics)}'
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
