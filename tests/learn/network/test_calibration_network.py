"""Networks of both architectures: what they correct, what teaches them, and what they must not care about."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from pipeline.learn.batches.batch import TrainingBatch, collate
from pipeline.learn.network.calibration_network import build_network
from pipeline.learn.network.views import NetworkInputs, crop, render, sensor_inputs
from pipeline.learn.sample.grid import GRAPH_INPUTS, PAIRS, Grid, NetworkConfig
from pipeline.learn.train.batch_loss import class_of_points, semantics_loss
from pipeline.objective.differentiable.projection import GridProjection, transform_points
from pipeline.objective.differentiable.terms import class_evidence_cost
from tests.makers import training_lakes

GRID = Grid(0.4, 25.6, 12.8, -12.8)
KINDS = [(a, p) for a in ("matching", "concat") for p in ("joint", *PAIRS)]


@lru_cache
def batch() -> TrainingBatch:
    return collate([training_lakes.sample_of(seed) for seed in range(2)])


def inputs_of(data, **changes) -> NetworkInputs:
    T = {"T_camera_lidar": data.T_camera_lidar, "T_lidar_radar": data.T_lidar_radar}
    T |= {"T_camera_radar": data.T_camera_radar}
    return NetworkInputs(sensor_inputs(data, GRID), **{k: v.float() for k, v in (T | changes).items()})


def small(architecture="matching", pairs="joint", seed=0):
    return build_network(NetworkConfig(architecture, pairs, GRID, width=8, hidden=32), seed)


def asked(network, inputs):
    return network.refine(inputs, 1)[0]


@pytest.mark.parametrize(("architecture", "pairs"), KINDS)
def test_a_network_corrects_its_pairs_rigidly_and_leaves_the_others(architecture, pairs):
    inputs = inputs_of(batch())
    network = small(architecture, pairs)
    with torch.no_grad():
        answer = asked(network, inputs)
    for pair in PAIRS:
        T = getattr(answer, f"T_{pair}")
        assert torch.allclose(
            T[:, :3, :3] @ T[:, :3, :3].transpose(1, 2), torch.eye(3).expand(2, 3, 3), atol=1e-5
        )
        moved = (T - getattr(inputs, f"T_{pair}")).abs().max() > 1e-7
        assert bool(moved) == (pairs in ("joint", pair))
    assert answer.log_variance.shape == (2, 3, 6)
    assert torch.isfinite(answer.log_variance).all()


def test_refinement_hands_turns_on_but_no_shifts_and_encodes_the_camera_once():
    network, inputs = small(), inputs_of(batch())
    calls = []
    network.core.camera_encoder.register_forward_hook(lambda *_: calls.append(1))
    with torch.no_grad():
        answers = network.refine(inputs, 3)
        by_hand = inputs
        for answer in answers:
            again = asked(network, by_hand)
            for pair in PAIRS:
                assert torch.allclose(getattr(again, f"T_{pair}"), getattr(answer, f"T_{pair}"), atol=1e-6)
            view, _ = render(by_hand, GRID)
            turns = network.core(view).corrections
            turns[:, :, :3, 3] = 0.0
            lidar, radar = turns[:, 0] @ by_hand.T_camera_lidar, turns[:, 2] @ by_hand.T_lidar_radar
            by_hand = replace(
                by_hand, T_camera_lidar=lidar, T_lidar_radar=radar, T_camera_radar=turns[:, 1] @ lidar @ radar
            )
    assert len(calls) == 1 + 6  # once in refine, twice in each pass by hand


def of_points(inputs):
    """Classes of the grid, and of lidar points and radar detections through the guess."""
    data = batch()
    classes = crop(data.grid_class, data.grid_step_deg, GRID)
    lidar = transform_points(inputs.T_camera_lidar, data.lidar_xyz_m)
    radar = transform_points(inputs.T_camera_radar, data.radar_xyz_m)
    seen = ((lidar, data.lidar_valid), (radar, data.radar_valid))
    return classes, *(class_of_points(classes, xyz, valid, GRID) for xyz, valid in seen)


def test_alignment_teaches_heads_and_temperatures_and_classes_teach_encoders():
    network, inputs = small(), inputs_of(batch())
    answer = asked(network, inputs)
    loss = sum(getattr(answer, f"T_{p}").pow(2).sum() for p in PAIRS) + answer.log_variance.sum()
    loss.backward(retain_graph=True)
    untaught = {n for n, p in network.named_parameters() if p.grad is None}
    assert untaught == {n for n, _ in network.named_parameters() if "_encoder" in n}
    semantics_loss(answer, *of_points(inputs)).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())


def test_evidence_at_the_reference_teaches_both_encoders():
    network, inputs, step = small(), inputs_of(batch()), np.radians(GRID.cell_deg)
    projection = GridProjection(*(step / 2 - np.radians(deg) for deg in (GRID.left_deg, GRID.top_deg)), step)
    optimiser, costs = torch.optim.Adam(network.parameters(), 1e-2), []
    for _ in range(5):
        optimiser.zero_grad()
        e, generator = asked(network, inputs).evidence, torch.Generator().manual_seed(0)
        points = transform_points(inputs.T_camera_lidar, e.points_m)
        costs.append(class_evidence_cost(projection, points, e.maps, e.probability, e.worth, generator))
        costs[-1].backward()
        optimiser.step()
    reached = {n.split(".")[1] for n, p in network.named_parameters() if p.grad is not None}
    assert reached == {"camera_encoder", "lidar_encoder"}
    assert costs[-1] < 0.9 * costs[0]


@pytest.mark.parametrize("pairs", ["camera_lidar", "camera_radar"])
def test_a_dozen_steps_on_two_frames_teach_classes(pairs):
    network, inputs, losses = small(pairs=pairs), inputs_of(batch()), []
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    for _ in range(12):
        optimiser.zero_grad()
        loss = semantics_loss(asked(network, inputs), *of_points(inputs))
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.75 * losses[0]


@pytest.mark.parametrize("architecture", ["matching", "concat"])
def test_exposure_and_contrast_do_not_matter(architecture):
    network, inputs = small(architecture), inputs_of(batch())
    camera = inputs.sensors.camera
    seen = camera[:, 3:]
    darker = torch.cat([(camera[:, :3] * 0.5 + 0.1) * seen, seen], 1)
    other = replace(inputs, sensors=replace(inputs.sensors, camera=darker))
    with torch.no_grad():
        first, second = asked(network, inputs), asked(network, other)
    assert torch.allclose(first.T_camera_lidar, second.T_camera_lidar, atol=2e-4)


def test_the_exported_graph_s_inputs_are_the_fields_of_a_view():
    view, index = render(inputs_of(batch()), GRID)
    assert tuple(vars(view)) == GRAPH_INPUTS
    assert view.lidar_grid[:, 0].sum() == (index >= 0).sum()
