"""Training on the paper's loss: the numbers of `joint-optimisation` on the same frames, and the paper's inputs."""

import numpy as np
import pytest
import torch

from pipeline.calibrate.paper_methods import joint_costs, pair_problem
from pipeline.core.errors import ConfigError
from pipeline.learn.batches.loader import load_split
from pipeline.learn.train.loop import read_metrics
from pipeline.learn.train.paper_objective import PaperFrames
from pipeline.learn.train.run import TrainRequest, network_of_run, train
from pipeline.learn.train.settings import PAIRS_OF, load_train_config
from pipeline.objective.paper.classes import loop_loss, loop_transform
from pipeline.rig.day_prior import read_prior
from pipeline.rig.se3 import changed
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import PAIRS
from tests.makers import training_lakes

DAY = Partition("vehicle-1", "2026-03-02")
FLEET = training_lakes.fleet_of(["vehicle-1"], val_fraction=0, test_fraction=0, grid=training_lakes.WIDE)
PAPER = """
architecture = "concat"
width = 4
hidden = 16
batch_size = 2
steps = 2
log_every = 1
uncertainty_weight = 0.0
[loss]
definition = "paper"
[augment]
view_deg = 0.0
mirror_share = 0.0
"""


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """A day of three frames, prepared, all of side train."""
    lake = Lake.at(tmp_path_factory.mktemp("day"))
    training_lakes.fill(lake, DAY.vehicle, DAY.day, 3)
    training_lakes.prepare_all(lake, FLEET)
    return lake


def test_the_loss_that_trains_is_the_objective_of_joint_optimisation_on_the_same_frames(lake):
    observations, rng = list(observations_of(lake, DAY)), np.random.default_rng(0)
    prior, batch = read_prior(observations, FLEET, DAY.vehicle), load_split(lake, "train")
    x = rng.uniform(-1, 1, (3, 18)) * np.tile([0.05, 0.05, 0.05, 0.2, 0.2, 0.2], 3)
    frames = PaperFrames(lake)
    problems = {pair: pair_problem(pair, observations, prior, FLEET.solve) for pair in PAIRS}
    letter = joint_costs(problems, prior, dict.fromkeys(PAIRS, 1.0), x)
    for k, moves in enumerate(x):
        T = {pair: changed(prior.of(pair), moves[None, 6 * i : 6 * i + 6]) for i, pair in enumerate(PAIRS)}
        given = [torch.tensor(np.repeat(T[pair], len(batch), 0), dtype=torch.float32) for pair in PAIRS]
        terms = frames.terms(batch, *given, PAIRS_OF["joint"])
        mean = {}
        for pair in PAIRS:
            expected = problems[pair].frame_losses(T[pair])[0]
            assert np.allclose(terms[pair].numpy(), expected, atol=2e-4)
            assert np.ptp(expected) > 1e-3  # else frames could be mixed up unseen
            mean[pair] = terms[pair].numpy()[problems[pair].informative].mean()
        loop = loop_loss(loop_transform(T["camera_lidar"], T["lidar_radar"], T["camera_radar"]))[0]
        assert terms["loop"].numpy() == pytest.approx(loop, abs=1e-4)
        equation_2 = (1 + sum(mean.values())) * (1 + terms["loop"].numpy()[0])
        assert equation_2 == pytest.approx(letter[k], rel=1e-3)


def test_a_run_on_the_papers_loss_descends_its_terms_and_learns_nothing_of_derived_channels(lake, tmp_path):
    recipe = tmp_path / "train.toml"
    recipe.write_text(PAPER)
    config = load_train_config(recipe, {})
    out = tmp_path / "run"
    assert train(TrainRequest(str(lake.root), out, "cpu"), config).status == "done"
    reports = [r for r in read_metrics(out) if "term/loop" in r]
    total = sum(reports[-1][f"term/{name}"] for name in (*PAIRS, "loop"))
    assert reports[-1]["alignment"] == pytest.approx(total, rel=1e-4)
    network = network_of_run(out, best=False)
    lidar = network.core.encoders["lidar"][0].weight.abs().amax(dim=(0, 2, 3))
    assert (lidar > 0).tolist() == [True, True, True, False, False, False]  # occupied, nearness, intensity
    radar = network.core.encoders["radar"][0].weight.abs().amax(dim=(0, 2, 3))
    assert (radar > 0).tolist() == [True] * 4 + [False]  # ..., Doppler, power; not whether it moves


def test_the_papers_loss_is_refused_with_what_is_not_the_papers(tmp_path):
    recipe = tmp_path / "train.toml"
    strange = f"{PAPER}[strange]\nimage = 1.0\n"
    changes = ("concat", "matching"), ("view_deg = 0.0", "view_deg = 4.0"), ("share = 0.0", "share = 0.5")
    for wrong in (strange, *(PAPER.replace(*change) for change in changes)):
        recipe.write_text(wrong)
        with pytest.raises(ConfigError, match="definition"):
            load_train_config(recipe, {})
