"""Lidar semantics by range images: projection, votes of neighbours, models and their faults, and whole days."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from pipeline.config import FleetConfig, config_hash, load_fleet
from pipeline.errors import ConfigError, ModelError
from pipeline.geometry.range_image import EMPTY, channels_of, project, vote_of_neighbours
from pipeline.perceive.ground import PointKind, find_ground, height_over
from pipeline.perceive.models.range_image import POINT_LABEL_SETS, RangeImageSegmenter
from pipeline.perceive.stage import perceive_day
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_rows, write_partition
from schemas.frames import FRAMES
from schemas.observations import OBSERVATIONS, Observation
from tests.makers.fleet_files import fleet_toml
from tests.makers.onnx_models import write_manifest

DAY = Partition("car-1", "2026-03-02")
SIZE, UP, DOWN = (32, 360), 10.0, -22.0  # 1 deg x 1 deg
KNN = {"neighbours": 5, "search": 5, "sigma_px": 1.0, "cutoff_m": 1.0}
LABELS = list(POINT_LABEL_SETS["semantickitti"])
CAR, ROAD, SIDEWALK, BUILDING = (LABELS.index(name) for name in ("car", "road", "sidewalk", "building"))


def points_of(rows, columns, range_m):
    """Points through the centres of pixels."""
    elevation = np.radians(UP - (np.asarray(rows) + 0.5))
    azimuth = np.radians(180 - (np.asarray(columns) + 0.5))
    rays = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    return (np.stack(rays, -1) * np.asarray(range_m)[..., None]).reshape(-1, 3).astype(np.float32)


def full_image(range_m=10.0):
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    return points_of(rows, columns, np.broadcast_to(range_m, SIZE))


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
    graph = helper.make_graph(
        nodes, "made",
        [helper.make_tensor_value_info("points", TensorProto.FLOAT, [1, channels, *size])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, classes, *size])],
        [numpy_helper.from_array(weights, "weights"), numpy_helper.from_array(bias, "bias")],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)


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


# projection


def test_points_through_pixel_centres_fall_into_their_pixels():
    points = full_image()
    image = project(points, SIZE, UP, DOWN)
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    assert image.inside.all()
    assert np.array_equal(image.row, rows.ravel())
    assert np.array_equal(image.column, columns.ravel())
    assert np.array_equal(image.point.ravel(), np.arange(len(points)))
    assert image.range_m == pytest.approx(10.0)


def test_left_of_the_vehicle_is_left_in_the_image_and_above_is_above():
    points = np.array([[9, 0.1, 0], [0.1, 9, 0], [0.1, -9, 0], [9, 0.1, 1]], np.float32)
    image = project(points, SIZE, UP, DOWN)
    ahead, left, right, high = zip(image.row, image.column, strict=True)
    assert left[1] < ahead[1] < right[1]
    assert ahead[1] == SIZE[1] // 2 - 1
    assert high[0] < ahead[0]


def test_of_points_in_one_pixel_the_nearest_is_drawn_whatever_their_order():
    ranges = np.array([30.0, 5.0, 12.0])
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        image = project(points_of([9] * 3, [44] * 3, ranges[order]), SIZE, UP, DOWN)
        assert image.range_m[9, 44] == pytest.approx(5.0)
        assert order[image.point[9, 44]] == 1
        assert np.sum(image.point != EMPTY) == 1


def test_channels_are_the_drawn_points_and_minus_one_elsewhere():
    points = points_of([3, 3, 20], [7, 7, 300], [8.0, 40.0, 15.0])
    remission = np.array([0.1, 0.2, 0.3], np.float32)
    channels = channels_of(project(points, SIZE, UP, DOWN), points, remission)
    assert channels[:, 3, 7] == pytest.approx([8.0, *points[0], 0.1], abs=1e-5)
    assert channels[:, 20, 300] == pytest.approx([15.0, *points[2], 0.3], abs=1e-5)
    assert np.sum(channels != -1) == 10


def test_points_beyond_the_field_of_view_are_neither_drawn_nor_labelled():
    points = points_of([-0.8, -5, 32.3, 10], [7, 8, 9, 10], [8.0] * 4)
    image = project(points, SIZE, UP, DOWN)
    assert image.inside.tolist() == [True, False, False, True]
    assert np.sum(image.point != EMPTY) == 2
    labels = vote_of_neighbours(image, np.full(SIZE, ROAD), 20, **KNN)
    assert labels.tolist() == [ROAD, 0, 0, ROAD]


# votes


def brute_vote(image, labels, n):
    """One point's label, pixel by pixel: the definition."""
    offsets = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]
    gauss = {o: np.exp(-(o[0] ** 2 + o[1] ** 2) / 2) for o in offsets}
    total = sum(gauss.values())
    found = []
    for i, j in offsets:
        row, column = image.row[n] + i, (image.column[n] + j) % SIZE[1]
        if 0 <= row < SIZE[0] and image.point[row, column] != EMPTY:
            difference = abs(image.range_m[row, column] - image.point_range_m[n])
            distance = 0.0 if (i, j) == (0, 0) else difference * (1 - gauss[i, j] / total)
            found.append((distance, labels[row, column]))
    votes = np.zeros(20)
    for distance, label in sorted(found, key=lambda f: f[0])[:5]:
        votes[label] += distance <= 1.0
    votes[0] = 0
    return int(np.argmax(votes))


def test_votes_are_those_of_the_definition():
    rng = np.random.default_rng(3)
    count = 9000
    rows, columns = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
    points = points_of(rows, columns, rng.uniform(4, 9, count))
    image = project(points, SIZE, UP, DOWN)
    labels = rng.integers(0, 5, SIZE)
    found = vote_of_neighbours(image, labels, 20, **KNN)
    some = rng.choice(count, 800, replace=False)
    assert found[some].tolist() == [brute_vote(image, labels, n) for n in some]


def test_an_image_of_one_label_gives_every_point_that_label():
    rng = np.random.default_rng(4)
    points = points_of(rng.uniform(0, 31, 3000), rng.uniform(0, 359, 3000), rng.uniform(3, 60, 3000))
    found = vote_of_neighbours(project(points, SIZE, UP, DOWN), np.full(SIZE, 7), 20, **KNN)
    assert set(found) == {7}


def test_a_wall_behind_a_pole_does_not_take_the_poles_label():
    wall = full_image(20.0)
    pole = points_of(np.arange(32), np.full(32, 100), np.full(32, 8.0))
    points = np.concatenate([wall, pole])
    image = project(points, SIZE, UP, DOWN)
    labels = np.where(image.range_m < 10, 18, BUILDING)
    assert np.all(labels[:, 100] == 18)  # the pixels show nothing of the wall there
    found = vote_of_neighbours(image, labels, 20, **KNN)
    assert np.all(found[: len(wall)] == BUILDING)
    assert np.all(found[len(wall) :][2:-2] == 18)


def test_a_pixel_beyond_the_cutoff_has_no_vote():
    alone = points_of([10], [50], [9.0])
    crowd = points_of([9, 10, 10, 11], [50, 49, 51, 50], [10.5] * 4)
    labels = np.full(SIZE, ROAD)
    labels[10, 50] = CAR
    image = project(np.concatenate([alone, crowd]), SIZE, UP, DOWN)
    assert vote_of_neighbours(image, labels, 20, **KNN)[0] == CAR
    assert vote_of_neighbours(image, labels, 20, **KNN | {"cutoff_m": 2.0})[0] == ROAD


def test_unlabelled_wins_only_where_nothing_else_votes():
    image = project(points_of([10, 10, 25], [50, 51, 50], [9.0, 9.1, 9.0]), SIZE, UP, DOWN)
    labels = np.zeros(SIZE, np.int64)
    labels[10, 51] = ROAD
    assert vote_of_neighbours(image, labels, 20, **KNN).tolist() == [ROAD, ROAD, 0]


def test_turning_the_lidar_by_whole_columns_changes_no_label():
    rng = np.random.default_rng(5)
    rows, columns = rng.integers(0, SIZE[0], 6000), rng.integers(0, SIZE[1], 6000)
    range_m, labels = rng.uniform(4, 9, 6000), rng.integers(1, 6, SIZE)
    found = vote_of_neighbours(project(points_of(rows, columns, range_m), SIZE, UP, DOWN), labels, 20, **KNN)
    turned = project(points_of(rows, (columns + 77) % SIZE[1], range_m), SIZE, UP, DOWN)
    again = vote_of_neighbours(turned, np.roll(labels, 77, axis=1), 20, **KNN)
    # Votes tie in range to the last float32 bit now and then, nowhere else.
    assert np.mean(found == again) > 0.999


# models


def test_labels_of_a_model_come_back_to_the_points_that_they_belong_to(tmp_path):
    rng = np.random.default_rng(6)
    ground = np.column_stack([rng.uniform(5, 20, 900), rng.uniform(-7, 7, 900), np.full(900, -1.7)])
    ground = ground[np.abs(np.abs(ground[:, 1]) - 4) > 1.0]
    kinds = RangeImageSegmenter(manifest(tmp_path)).kinds(ground.astype(np.float32), None)
    side = np.abs(ground[:, 1]) > 4
    assert np.mean(kinds[side] == PointKind.FLAT) > 0.97
    assert np.mean(kinds[~side] == PointKind.ROAD) > 0.97


def test_every_label_of_the_set_has_its_kind(tmp_path):
    for label, name in enumerate(LABELS):
        segmenter = RangeImageSegmenter(manifest(tmp_path, {label: (NONE, NONE, 0.0)}))
        found = segmenter.kinds(points_of([10], [50], [9.0]), None)
        assert found.tolist() == [POINT_LABEL_SETS["semantickitti"][name]], name


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


@pytest.mark.parametrize(("empty", "kind"), [("zero", PointKind.ROAD), ("minus_one", PointKind.OTHER)])
def test_empty_pixels_are_what_the_manifest_says(tmp_path, empty, kind):
    # Sum of normalised ranges over 3 x 3 pixels, a lone point at the mean: 0, or 8 x (-1 - 9)/5 = -16.
    rules = {ROAD: ((1, 0, 0, 0, 0), NONE, 8.0), BUILDING: (NONE, NONE, 0.0)}
    given = {"mean": [9.0, 0.0, 0.0, 0.0, 0.0], "std": [5.0, 1.0, 1.0, 1.0, 1.0], "empty": empty}
    file = manifest(tmp_path, rules, given=given, window=3)
    assert RangeImageSegmenter(file).kinds(points_of([10], [50], [9.0]), None).tolist() == [kind]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('path = "seg.onnx"', 'path = "none.onnx"', "path"),
        ('sha256 = "', 'sha256 = "00', "sha256"),
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
        ("[output]", "colour = 1\n[output]", "colour"),
        ("[output]", "[output", "TOML"),
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


def test_another_model_than_the_manifest_means_is_refused(tmp_path):
    file = manifest(tmp_path)
    with (tmp_path / "seg.onnx").open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(ModelError, match="sha256"):
        RangeImageSegmenter(file)
    with pytest.raises(ModelError, match="no such manifest"):
        RangeImageSegmenter(tmp_path / "none.toml")


def test_models_of_another_shape_than_their_manifest_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"1, 5, rows"):
        RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE[:4], NONE[:4], 0.0)}, channels=4))
    few = RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE, NONE, 0.0)}, classes=13))
    with pytest.raises(ModelError, match=r"output\.layout.*20.*13"):
        few.kinds(points_of([10], [50], [9.0]), None)
    broken = RangeImageSegmenter(manifest(tmp_path, {ROAD: (NONE, NONE, np.nan)}))
    with pytest.raises(ModelError, match="not finite"):
        broken.kinds(points_of([10], [50], [9.0]), None)


# ground


def street(rng, count=30000):
    """A road of |y| < 4 m, sidewalks level with it to 8 m, and a low flat-bed trailer's side on the road."""
    x, y = rng.uniform(-30, 30, count), rng.uniform(-8, 8, count)
    # Smooth: RANSAC takes the lowest point of each cell, and so lies some sigmas of roughness low.
    road = np.column_stack([x, y, rng.normal(-1.7, 0.003, count)])
    trailer = rng.uniform([12.0, -1.0, -1.68], [12.4, 1.0, -1.45], (600, 3))
    points = np.concatenate([road, trailer]).astype(np.float32)
    kind = np.where(np.abs(points[:, 1]) < 4, PointKind.ROAD, PointKind.FLAT).astype(np.uint8)
    kind[count:] = PointKind.ROAD_USER
    return points, kind


def test_the_drivable_area_ends_where_the_models_road_does():
    rng = np.random.default_rng(7)
    points, kind = street(rng)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    assert np.abs(plain.drivable_xyz_m[:, 1]).max() > 7  # geometry cannot tell a level sidewalk
    assert np.abs(told.drivable_xyz_m[:, 1]).max() <= 4
    seen = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.mean(told.is_ground[(kind == PointKind.FLAT) & seen]) > 0.99
    assert not (told.is_road & ~(told.is_ground & (kind == PointKind.ROAD))).any()
    assert np.mean(told.is_road[(kind == PointKind.ROAD) & seen]) > 0.99
    assert told.plane[3] == pytest.approx(1.7, abs=0.01)


def test_road_users_are_no_ground_and_block_however_low_they_are():
    rng = np.random.default_rng(8)
    points, kind = street(rng)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    user = kind == PointKind.ROAD_USER
    assert np.mean(plain.is_ground[user]) > 0.5
    assert not told.is_ground[user].any()
    behind = lambda found: np.sum((found[:, 0] > 14) & (np.abs(found[:, 1]) < 1))  # noqa: E731
    assert behind(plain.drivable_xyz_m) > 20
    assert behind(told.drivable_xyz_m) == 0


def test_ransac_drops_what_the_model_took_for_road():
    rng = np.random.default_rng(9)
    points, kind = street(rng)
    wall = rng.uniform([5, 3.0, -1.0], [25, 3.4, 1.0], (4000, 3)).astype(np.float32)
    points = np.concatenate([points, wall])
    kind = np.append(kind, np.full(4000, PointKind.ROAD, np.uint8))
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert found.plane[3] == pytest.approx(1.7, abs=0.02)
    assert found.plane[2] > np.cos(np.radians(0.5))
    assert not (found.is_ground | found.is_road)[-4000:].any()


def test_geometry_decides_on_points_that_the_model_does_not_know():
    rng = np.random.default_rng(10)
    points, kind = street(rng)
    far = np.abs(points[:, 1]) > 6
    kind[far] = PointKind.UNKNOWN
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert np.mean(found.is_ground[far]) > 0.95
    assert not found.is_road[far].any()
    assert np.abs(height_over(found.plane, points[far])).max() < 0.2


def test_the_surface_does_not_climb_what_the_model_knows_for_an_object():
    points, kind = street(np.random.default_rng(12))
    hedge = (points[:, 0] > 10) & (points[:, 0] < 20)  # rises like a hill, across the whole street
    points[hedge, 2] += 0.05 * (points[hedge, 0] - 10)
    kind[hedge] = PointKind.OTHER
    beyond = (points[:, 0] > 20) & (points[:, 0] < 26) & (np.abs(points[:, 1]) < 4)
    plain, told = (find_ground(points, 0.15, np.random.default_rng(0), k) for k in (None, kind))
    assert np.mean(plain.is_ground[hedge]) > 0.5
    assert not told.is_ground[hedge].any()
    assert np.mean(plain.is_ground[beyond]) < 0.5
    assert np.mean(told.is_ground[beyond]) > 0.99


def test_too_little_road_gives_no_plane_and_no_drivable_area_but_keeps_the_models_ground():
    points, kind = street(np.random.default_rng(11))
    kind[kind == PointKind.ROAD] = PointKind.OTHER
    found = find_ground(points, 0.15, np.random.default_rng(0), kind)
    assert found.plane is None
    assert len(found.drivable_xyz_m) == 0
    seen = np.hypot(points[:, 0], points[:, 1]) > 2.6
    assert np.array_equal(found.is_ground[seen], kind[seen] == PointKind.FLAT)


# days


def fleet(folder, semantics=""):
    toml = folder / "fleet.toml"
    toml.write_text(fleet_toml("car-1", lidar=semantics))
    return toml


def perceived(toml, lake):
    result = perceive_day(DAY, load_fleet(toml), lake)
    return result, read_rows(lake, OBSERVATIONS, DAY, Observation)


@pytest.fixture
def lake(tmp_path, made_frame):
    lake = Lake.at(tmp_path / "lake")
    with write_partition(lake, FRAMES, DAY, "frames-key", "test") as writer:
        writer.append([made_frame(i) for i in range(3)])
        writer.describe(kept={}, rejected={})
    return lake


MODEL = 'semantics = { source = "onnx", segmenter = "seg.toml" }'


def test_a_day_is_perceived_with_a_model_and_anew_with_another(tmp_path, lake):
    without, plain = perceived(fleet(tmp_path), lake)
    manifest(tmp_path)
    first, told = perceived(fleet(tmp_path, MODEL), lake)
    assert (first.status, first.rows) == ("done", 3)
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


def test_a_day_without_a_model_is_what_it_was_and_models_need_no_new_ingest(tmp_path):
    plain, told = load_fleet(fleet(tmp_path)), load_fleet(fleet(tmp_path, MODEL))
    assert told.rigs["default"].lidar.semantics.segmenter == "seg.toml"
    assert config_hash(plain.rigs["default"]) == config_hash(told.rigs["default"])
    assert FleetConfig.model_validate(plain.model_dump(mode="json")).read_from(plain.file) == plain
    assert plain.model_dump(mode="json")["rigs"]["default"]["lidar"] == {"points": "/lidar/points"}


def test_a_sweep_without_intensity_and_with_bad_points_is_perceived_too(tmp_path, made_frame):
    lake, frame = Lake.at(tmp_path / "lake"), made_frame()
    x = frame.lidar_x_m.copy()
    x[::50] = np.nan
    with write_partition(lake, FRAMES, DAY, "frames-key", "test") as writer:
        writer.append([replace(frame, lidar_x_m=x, lidar_intensity=None)])
        writer.describe(kept={}, rejected={})
    manifest(tmp_path)
    result, rows = perceived(fleet(tmp_path, MODEL), lake)
    assert result.status == "done"
    assert np.abs(rows[0].lidar_drivable_xyz_m[:, 1]).max() < 4.5
    assert len(rows[0].marking_z) == 0


@pytest.mark.parametrize(
    "semantics",
    ['semantics = { source = "topics" }', MODEL.replace(" }", ", detector = 1 }"),
     MODEL.replace(" }", ", remission_scale = 0.0 }")],
)  # fmt: skip
def test_impossible_settings_of_the_lidar_are_refused_by_key(tmp_path, semantics):
    with pytest.raises(ConfigError, match=r"rigs\.default\.lidar\.semantics"):
        load_fleet(fleet(tmp_path, semantics))


def test_a_day_whose_model_is_missing_or_wrong_names_the_manifest(tmp_path, lake):
    with pytest.raises(ModelError, match=r"seg\.toml.*no such manifest"):
        perceived(fleet(tmp_path, MODEL), lake)
    manifest(tmp_path, {ROAD: (NONE, NONE, 0.0)}, classes=12)
    with pytest.raises(ModelError, match=r"seg\.toml.*logits must be"):
        perceived(fleet(tmp_path, MODEL), lake)
