"""Strange sensors: as strange as asked, the same for the same seed, and never what the losses compare."""

from dataclasses import replace

import torch

from pipeline.learn.network.views import SensorInputs, given_classes
from pipeline.learn.train.domain_randomisation import made_strange
from pipeline.learn.train.settings import StrangeConfig

FRAMES = 24
ALL = StrangeConfig(image=1, classes=1, no_classes=0.3, no_image=0.3, lidar=1, fewer_rows=0.5)


def sensors() -> SensorInputs:
    """Frames with stripes of classes, and a lidar of 64 rows."""
    kind = (torch.arange(64) // 8 % 10).to(torch.uint8).expand(FRAMES, 32, 64)
    seen = torch.ones(FRAMES, 1, 32, 64)
    seen[..., :4, :] = 0
    azimuth, elevation = torch.meshgrid(
        torch.linspace(-0.5, 0.5, 40), torch.linspace(-0.4, 0.2, 64), indexing="ij"
    )
    xyz = 20 * torch.stack(
        [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()], -1
    )
    xyz = xyz.reshape(1, -1, 3).expand(FRAMES, -1, 3)
    features = torch.rand(FRAMES, xyz.shape[1], 4, generator=torch.Generator().manual_seed(1))
    radar = torch.rand(FRAMES, 5, 3)
    valid = torch.ones(FRAMES, xyz.shape[1], dtype=torch.bool)
    camera = torch.cat([0.3 + 0.4 * torch.rand(FRAMES, 3, 32, 64), torch.ones(FRAMES, 1, 32, 64)], 1) * seen
    of_radar = radar, radar, valid[:, :5], valid[:, 0]
    return SensorInputs(camera, given_classes(kind), xyz, features, valid, *of_radar, torch.ones(FRAMES))


def strange(config, seed=0):
    return made_strange(sensors_once, config, torch.Generator().manual_seed(seed))


sensors_once = sensors()


def test_the_same_seed_makes_the_same_and_another_seed_another():
    one, again, other = strange(ALL), strange(ALL), strange(ALL, seed=1)
    for name in ("camera", "classes", "lidar_features", "lidar_valid"):
        assert torch.equal(getattr(one, name), getattr(again, name))
        assert not torch.equal(getattr(one, name), getattr(other, name))


def test_classes_stay_likelihoods_that_are_right_more_often_than_not():
    found = strange(replace_config(no_classes=0.0)).classes
    known = found[:, -1] > 0
    assert 0.7 < known.float().mean() < 1
    assert torch.allclose(found[:, :-1].sum(1)[known], torch.ones(()), atol=1e-4)
    assert found[:, :-1].amax(1)[~known].max() == 0
    right = (found[:, :-1].argmax(1) == sensors_once.classes[:, :-1].argmax(1))[known].float().mean()
    assert 0.7 < right < 0.99


def test_frames_lose_their_classes_or_their_image_and_never_both():
    found = strange(replace_config(image=0.0, classes=0.0))
    without_classes = found.classes.amax((1, 2, 3)) == 0
    without_image = found.camera[:, :3].amax((1, 2, 3)) == 0
    assert 0 < without_classes.sum() < FRAMES
    assert 0 < without_image.sum() < FRAMES
    assert not (without_classes & without_image).any()
    assert torch.equal(found.camera[:, 3], sensors_once.camera[:, 3])  # what is seen is known


def test_images_change_where_the_camera_sees_and_stay_images():
    found = strange(replace_config(no_image=0.0)).camera
    assert (found - sensors_once.camera).abs().mean() > 0.02
    assert found.min() >= 0
    assert found.max() <= 1
    assert found[..., :4, :].abs().max() == 0


def test_some_sweeps_have_rows_a_degree_apart_and_none_is_thinned_to_nothing():
    found = strange(replace_config(lidar=0.0)).lidar_valid
    share = found.float().mean(1)
    assert ((share < 0.5) | (share == 1)).all()
    assert 0 < (share == 1).sum() < FRAMES
    assert found.sum(1).min() >= 300
    few = replace(sensors_once, lidar_valid=torch.arange(found.shape[1]).expand(FRAMES, -1) < 310)
    kept = made_strange(few, ALL, torch.Generator().manual_seed(0)).lidar_valid
    assert kept.sum(1).min() >= 300


def replace_config(**changes) -> StrangeConfig:
    return ALL.model_copy(update=changes)
