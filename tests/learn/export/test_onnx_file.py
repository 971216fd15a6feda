"""The exported file computes what the network computes, says what it is, and needs neither torch nor semantics."""

import json
from functools import lru_cache

import numpy as np
import onnx
import pytest
import torch

from pipeline.core.errors import ModelError
from pipeline.learn.batches.batch import collate
from pipeline.learn.export.onnx_file import export_onnx
from pipeline.learn.infer.onnx_networks import OnnxNetwork
from pipeline.learn.network.calibration_network import build_network, network_of_file, weight_places
from pipeline.learn.network.views import NetworkInputs, crop, given_classes, render, sensor_inputs
from pipeline.learn.sample.grid import PAIRS, Grid, NetworkConfig
from pipeline.learn.sample.rendering import frame_sensors
from pipeline.rig.se3 import exp_so3, transform_points
from schemas.training import GRID_CLASSES
from schemas.versions import CODE_VERSION
from tests.makers import solve_scenes, training_lakes

GRID = Grid(0.4, 25.6, 12.8, -12.8)
CARD = {"data": "two frames", "seeds": [0], "results": {"azimuth_deg": 0.1}}
OTHERS = ["matching-joint", "matching-camera_radar", "matching-lidar_radar"]  # torch takes 4 s to trace each
KINDS = ["classes-joint", "concat-joint", *(pytest.param(kind, marks=pytest.mark.slow) for kind in OTHERS)]


@lru_cache
def row():
    return training_lakes.sample_of(lidar_points=4096)


def classes():
    """What a segmenter gives, one class a cell as table training holds it."""
    return given_classes(crop(collate([row()]).grid_class, 0.4, GRID))[0].numpy()


def guess():
    wrong = np.eye(4)
    wrong[:3, :3] = exp_so3(np.radians([1.0, -1.5, 0.5]))
    T_camera_lidar, T_lidar_radar = wrong @ solve_scenes.T_CAMERA_LIDAR, wrong @ solve_scenes.T_LIDAR_RADAR
    return dict(zip(PAIRS, (T_camera_lidar, T_camera_lidar @ T_lidar_radar, T_lidar_radar), strict=True))


def inputs():
    given = {f"T_{pair}": torch.tensor(T, dtype=torch.float32)[None] for pair, T in guess().items()}
    return NetworkInputs(sensor_inputs(collate([row()]), GRID), **given)


@pytest.fixture(scope="module", params=KINDS)
def exported(request, tmp_path_factory):
    """A network with weights as large as trained ones, its file, and the file opened."""
    architecture, pairs = request.param.split("-")
    takes_classes = architecture == "classes"
    architecture = "matching" if takes_classes else architecture
    more = {"takes_classes": takes_classes, "marks": takes_classes}
    config = NetworkConfig(architecture, pairs, GRID, width=8, hidden=32, **more)
    network = build_network(config)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for layer in network.core.heads.layers.values():
            size = 0.01 if architecture == "matching" else 0.05  # half a degree of residuals
            layer.weight += size * torch.randn(layer.weight.shape, generator=generator)
    path = export_onnx(network, tmp_path_factory.mktemp("model") / "model.onnx", CARD)
    return network, path, OnnxNetwork(path)


def test_the_file_computes_what_the_network_computes_in_one_pass_and_in_three(exported):
    network, _, opened = exported
    sensors = frame_sensors(row(), GRID, classes())
    ours = opened.estimate(sensors, guess())
    with torch.no_grad():
        theirs = network.refine(inputs(), 3)
    assert sum(np.abs(T - guess()[p]).max() for p, T in ours[0].T.items()) > 1e-3  # else parity of nothing
    # A point on a cell's border may fall to another side after rounding: a hundredth of a degree at most.
    for one, other, near in ((ours[0], theirs[0], 1e-5), (ours[-1], theirs[-1], 2e-4)):
        for pair, T in one.T.items():
            assert pytest.approx(getattr(other, f"T_{pair}")[0].numpy(), abs=near) == T
            assert pytest.approx(np.eye(3), abs=1e-12) == T[:3, :3] @ T[:3, :3].T
    for pair, variance in ours[0].variance.items():
        expected = theirs[0].log_variance[0, PAIRS.index(pair)].numpy()
        assert np.log(variance) == pytest.approx(expected, abs=1e-4)
    assert (len(ours), tuple(ours[0].T)) == (3, network.config.estimated)


def test_what_a_file_matches_by_is_what_the_network_matches_by(exported):
    network, _, opened = exported
    T_camera_lidar = guess()["camera_lidar"]
    sensors = frame_sensors(row(), GRID, classes())
    told = opened.evidence("camera_lidar", sensors, T_camera_lidar)
    if (scan := opened.evidence("lidar_radar", sensors, T_camera_lidar)) is not None:
        assert scan.width == pytest.approx(network.core.radar_matcher.log_width.detach().exp().numpy())
    assert (scan is None) == (not hasattr(network.core, "radar_matcher"))
    with torch.no_grad():
        view, _ = render(inputs(), GRID, classes=network.config.takes_classes)
        evidence = network.core(view).evidence
    assert (told is None) == (evidence is None)
    if told is None:
        return
    assert told.maps == pytest.approx(evidence.maps[0].permute(1, 2, 0).numpy(), abs=1e-4)
    present = evidence.worth[0].numpy() > 0
    assert told.probability[present] == pytest.approx(evidence.probability[0].numpy()[present], abs=1e-4)
    points = torch.cat([view.points_camera, view.marks_camera], 1)[0].double().numpy()[: len(present)]
    seen = transform_points(T_camera_lidar, told.points_m.astype(np.float64))
    assert seen[present] == pytest.approx(points[present], abs=1e-3)


def test_a_file_that_takes_classes_answers_without_them_and_otherwise(exported):
    network, _, opened = exported
    sensors = frame_sensors(row(), GRID, classes())
    asked = [sensors, frame_sensors(row(), GRID), sensors.without_image()]
    answers = [np.stack([*opened.estimate(s, guess(), 1)[0].T.values()]) for s in asked]
    differs = not np.allclose(answers[0], answers[1], atol=1e-6)
    assert differs == network.config.takes_classes
    assert np.isfinite(answers).all()


def test_the_file_is_a_checked_graph_of_a_recent_opset_and_carries_its_card(exported):
    network, path, _ = exported
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert {o.version for o in model.opset_import if o.domain == ""} == {18}
    metadata = {m.key: m.value for m in model.metadata_props}
    assert json.loads(metadata["classes"]) == list(GRID_CLASSES)
    assert json.loads(metadata["grid"])["cell_deg"] == GRID.cell_deg
    assert metadata["architecture"] == network.config.architecture
    assert metadata["code_version"] == CODE_VERSION
    assert json.loads(metadata["card"]) == CARD
    card = json.loads(path.with_suffix(".json").read_text())
    assert card["results"] == CARD["results"]
    assert card["bytes"] == path.stat().st_size
    assert "azimuth_deg: 0.1" in path.with_suffix(".md").read_text()


def test_a_network_can_be_trained_on_from_its_file(exported):
    network, path, _ = exported
    again = network_of_file(path)
    assert again.config == network.config
    for name, value in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert len(json.dumps(weight_places(network.state_dict(), onnx.load(path)))) < 16_000


def test_a_file_that_is_no_such_model_is_refused_by_name(tmp_path):
    path = tmp_path / "model.onnx"
    with pytest.raises(ModelError, match=r"model\.onnx"):
        OnnxNetwork(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(ModelError, match="ONNX"):
        OnnxNetwork(path)
    graph = onnx.helper.make_graph([], "empty", [], [])
    onnx.save(onnx.helper.make_model(graph), path)
    with pytest.raises(ModelError, match="boresight export"):
        OnnxNetwork(path)
    with pytest.raises(ModelError, match="weights"):
        network_of_file(path)
