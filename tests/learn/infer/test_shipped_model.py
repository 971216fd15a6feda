"""The network that comes with Boresight: its size, its card, and what it does on a rig that it never learned from."""

import numpy as np
import pytest

from pipeline.calibrate.networks import calibrate_frame
from pipeline.core.config import LearnConfig, PrepareConfig
from pipeline.core.stage_work import Task
from pipeline.learn.infer.onnx_networks import SHIPPED, model_files, open_networks
from pipeline.rig.targets import errors_at_targets
from schemas.calibrations import PAIRS
from tests.makers.simulated_days import simulated_day
from tests.makers.training_lakes import fleet_of

MODEL, WITH_CLASSES = SHIPPED / "joint.onnx", SHIPPED / "joint_classes.onnx"


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    return simulated_day(tmp_path_factory.mktemp("day"), frames=4, rig="demo", seed=77)


@pytest.mark.parametrize("model", [MODEL, WITH_CLASSES], ids=lambda path: path.stem)
def test_it_is_small_and_onnxruntime_opens_it(model):
    assert model.stat().st_size <= 2_500_000
    [network] = open_networks({"joint": model}, LearnConfig(), PrepareConfig())
    assert network.pairs == PAIRS


@pytest.mark.parametrize(
    ("camera", "model"), [("both", WITH_CLASSES), ("classes", WITH_CLASSES), ("image", MODEL)]
)
def test_a_fleet_that_names_no_network_gets_the_one_that_fits_what_it_is_shown(camera, model):
    assert model_files("joint-ssl", fleet_of("a").changed(learn={"camera": camera})) == {"joint": model}


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["both", "image"])
def test_one_frame_puts_sensors_right_that_were_knocked_by_five_degrees(day, camera):
    """Median over frames, of a rig that neither network learned from."""
    before, after = [], []
    for o in day.observations:
        task = Task(
            day.fleet.changed(learn={"camera": camera}),
            day.lake,
            day.partition,
            "joint-ssl",
            o.frame_index,
            (5.0, 0.05),
        )
        found = calibrate_frame(task, o.frame_index)
        before.append([off(day, pair, found.prior.of(pair)) for pair in PAIRS])
        after.append([off(day, pair, found.solution.pairs[pair].T) for pair in PAIRS])
    before, after = np.median(np.degrees(before), axis=0), np.median(np.degrees(after), axis=0)
    assert (np.linalg.norm(after, axis=1) < np.linalg.norm(before, axis=1) / 4).all(), (before, after)


def off(day, pair, T):
    """Azimuth and elevation [rad] at the paper's targets."""
    return errors_at_targets(pair, T, day.truth[pair])[:2]
