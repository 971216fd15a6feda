"""Lidar semantics by range-image models: their labels, their faults, and whole days."""

import numpy as np
import pytest
from onnx import TensorProto, helper

from pipeline.core.config import load_fleet
from pipeline.core.errors import ModelError
from pipeline.core.models import shipped_manifest
from pipeline.perceive.ground import PointKind
from pipeline.perceive.models.range_image import POINT_LABEL_SETS, RangeImageSegmenter
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_frames
from tests.makers.onnx_models import save_graph, write_manifest
from tests.makers.range_scenes import DOWN, SIZE, UP, points_of
from tests.makers.stages import perceive_day

DAY = Partition("car-1", "2026-03-02")
LABELS = list(POINT_LABEL_SETS["semantickitti"])
ROAD, SIDEWALK, BUILDING = (LABELS.index(name) for name in ("road", "sidewalk", "building"))


def save_linear(path, rules, *, size=SIZE, window=1, classes=20, channels=5):
    """Logits = bias + weights x the five channels + weights x their magnitudes, summed over a window.

    `rules`: label -> (weights, weights of magnitudes, bias); all other labels are hopeless.
    """
    weights = np.zeros((classes, 2 * channels, window, window), np.float32)
    bias = np.full(classes, -1e6, np.float32)
    for label, (plain, magnitude, offset) in rules.items():
        weights[label] = np.array([*plain, *magnitude], np.float32)[:, None, None]
        bias[label] = offset
    nodes = [
        helper.make_node("Abs", ["points"], ["magnitude"]),
        helper.make_node("Concat", ["points", "magnitude"], ["both"], axis=1),
        helper.make_node("Conv", ["both", "weights", "bias"], ["logits"], pads=[window // 2] * 4),
    ]
    save_graph(
        path, nodes,
        [helper.make_tensor_value_info("points", TensorProto.FLOAT, [1, channels, *size])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, classes, *size])],
        {"weights": weights, "bias": bias},
    )  # fmt: skip


NONE = (0, 0, 0, 0, 0)
# By height and distance from the middle of the road: road, sidewalk beyond |y| = 4 m, buildings above -1.3 m.
STREET = {
    ROAD: (NONE, NONE, 0.0),
    SIDEWALK: (NONE, (0, 0, 10, 0, 0), -40.0),
    BUILDING: ((0, 0, 0, 300, 0), NONE, 390.0),
}


def manifest(folder, rules=STREET, *, given=None, name="seg", **graph):
    save_linear(folder / f"{name}.onnx", rules, **graph)
    spec = {
        "size": list(SIZE), "fov_up_deg": UP, "fov_down_deg": DOWN, "mean": [0.0] * 5, "std": [1.0] * 5,
    } | (given or {})  # fmt: skip
    output = {"layout": "logits", "label_set": "semantickitti"}
    return write_manifest(folder / f"{name}.toml", folder / f"{name}.onnx", "segment_points", spec, output)


# models


def test_remission_is_scaled_and_normalised_and_its_mean_where_the_log_has_none(tmp_path):
    # Road where remission is above the mean of training, buildings where it is not.
    rules = {ROAD: ((0, 0, 0, 0, 1), NONE, -1e-3), BUILDING: (NONE, NONE, 0.0)}
    given = {"mean": [0.0, 0.0, 0.0, 0.0, 0.4], "std": [1.0, 1.0, 1.0, 1.0, 0.2]}
    file = manifest(tmp_path, rules, given=given)
    points = points_of([5, 15, 25], [50, 150, 250], [9.0] * 3)
    intensity = np.array([90, 120, np.nan], np.float32)
    road, other = PointKind.ROAD, PointKind.OTHER
    assert RangeImageSegmenter(file, 1 / 255).kinds(points, intensity).tolist() == [other, road, other]
    assert RangeImageSegmenter(file).kinds(points, intensity).tolist() == [road, road, other]
    assert RangeImageSegmenter(file).kinds(points, None).tolist() == [other] * 3


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('task = "segment_points"', 'task = "segment"', "task"),
        ("size = [32, 360]", "size = [32]", "input.size"),
        ("size = [32, 360]", "size = [32, 180]", r"input\.size.*model's input"),
        ("fov_up_deg = 10.0", "fov_up_deg = -30.0", "fov_up_deg"),
        ("mean = [0.0, 0.0, 0.0, 0.0, 0.0]", "mean = [0.0, 0.0, 0.0]", "input.mean"),
        ("std = [1.0, 1.0, 1.0, 1.0, 1.0]", "std = [1.0, 1.0, 0.0, 1.0, 1.0]", "std"),
        ('layout = "logits"', 'layout = "yolox"', "output.layout"),
        ('label_set = "semantickitti"', 'label_set = "coco"', "label_set"),
        ("[output]", "[knn]\nsearch = 4\n[output]", "knn.*odd"),
        ("[output]", "[knn]\nneighbours = 26\n[output]", "knn.*25 pixels"),
        ("[output]", "[knn]\nsearch = 33\n[output]", r"knn\.search"),
    ],
)
def test_a_wrong_manifest_is_refused_by_key(tmp_path, old, new, words):
    file = manifest(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ModelError, match=words) as error:
        RangeImageSegmenter(file)
    assert str(file) in str(error.value)


def test_models_of_another_shape_than_their_manifest_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"1, 5, rows"):
        RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE[:4], NONE[:4], 0.0)}, channels=4))
    few = RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE, NONE, 0.0)}, classes=13))
    with pytest.raises(ModelError, match=r"output\.layout.*20.*13"):
        few.kinds(points_of([10], [50], [9.0]), None)
    broken = RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE, NONE, np.nan)}))
    with pytest.raises(ModelError, match="NaN"):
        broken.kinds(points_of([10], [50], [9.0]), None)


# days


def fleet(folder, semantics=""):
    toml = folder / "fleet.toml"
    toml.write_text(fleet_toml("car-1", lidar=semantics))
    return toml


def perceived(toml, lake):
    result = perceive_day(DAY, load_fleet(toml), lake)
    return result, list(observations_of(lake, DAY))


@pytest.fixture
def lake(tmp_path, made_frame):
    lake = Lake.at(tmp_path / "lake")
    write_frames(lake, DAY, [made_frame(i) for i in range(2)], "frames-key")
    return lake


MODEL = 'semantics = { source = "onnx", segmenter = "seg.toml" }'


def test_a_day_is_perceived_with_a_model_and_anew_with_another(tmp_path, lake):
    without, plain = perceived(fleet(tmp_path), lake)
    manifest(tmp_path)
    first, told = perceived(fleet(tmp_path, MODEL), lake)
    assert (first.status, first.rows) == ("done", 2)
    assert first.work_key != without.work_key
    for a, b in zip(plain, told, strict=True):
        assert np.abs(a.lidar_drivable_xyz_m[:, 1]).max() > 6.5  # to the walls
        assert len(b.lidar_drivable_xyz_m) > 30
        assert np.abs(b.lidar_drivable_xyz_m[:, 1]).max() < 4.5  # to the sidewalk
        assert np.abs(b.marking_xyz_m[:, 1]).max() < 4.6
        assert b.ground_plane[3] == pytest.approx(1.7, abs=0.05)
        # Sidewalks are ground still, not objects.
        side = (np.abs(b.lidar_map_xyz_m[:, 1]) > 5) & (b.lidar_map_xyz_m[:, 2] < -1.5)
        side &= np.hypot(*b.lidar_map_xyz_m[:, :2].T) < 20
        assert np.mean(b.lidar_map_is_ground[side]) > 0.9
        # What neither the lidar nor its ground has a part in is as it was.
        assert np.array_equal(a.radar_drivable_range_m, b.radar_drivable_range_m)
        assert np.array_equal(a.lidar_map_xyz_m, b.lidar_map_xyz_m)
    assert perceived(fleet(tmp_path, MODEL), lake)[0].status == "cached"
    manifest(tmp_path, STREET | {SIDEWALK: (NONE, (0, 0, 10, 0, 0), -30.0)})
    again, narrower = perceived(fleet(tmp_path, MODEL), lake)
    assert again.status == "done"
    assert np.abs(narrower[0].lidar_drivable_xyz_m[:, 1]).max() < 3.6
    scaled = MODEL.replace(" }", ", remission_scale = 0.5 }")
    assert perceived(fleet(tmp_path, scaled), lake)[0].status == "done"


def test_a_day_whose_model_is_missing_or_wrong_names_the_manifest(tmp_path, lake):
    config = load_fleet(fleet(tmp_path, MODEL))
    with pytest.raises(ModelError, match=r"seg\.toml.*no such manifest"):
        perceive_day(DAY, config, lake)
    manifest(tmp_path, {ROAD: (NONE, NONE, 0.0)}, classes=12)
    refused = perceive_day(DAY, config, lake)
    assert (refused.status, refused.faults) == ("refused", ("model_output",))
    assert "seg.toml" in refused.reason


def test_the_network_that_ships_tells_a_road_from_the_walls_beside_it():
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-60, 60, 0.4)), np.radians(np.arange(-18, 6, 0.75)))
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    ).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, -1.8 / rays[:, 2], np.inf)
        to_wall = np.where(rays[:, 1] != 0, 9.0 / np.abs(rays[:, 1]), np.inf)
    distance = np.minimum(to_ground, to_wall)
    seen = distance < 60
    xyz = (rays * distance[:, None])[seen].astype(np.float32)
    is_wall = (to_wall < to_ground)[seen]
    segmenter = RangeImageSegmenter(shipped_manifest("shipped:lidar_semantics"))
    is_ground = np.isin(
        segmenter.kinds(xyz, np.full(len(xyz), 0.3, np.float32)), (PointKind.ROAD, PointKind.FLAT)
    )
    assert is_ground[~is_wall].mean() > 0.8
    assert is_ground[is_wall & (xyz[:, 2] > -0.8)].mean() < 0.2
