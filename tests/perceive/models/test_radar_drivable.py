"""A network in place of the geometric drivable area: the whole way from training to the column, and its faults."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core.config import FleetConfig
from pipeline.learn.perception_training.radar_drivable import (
    DrivableTraining,
    RadarDrivable,
    day_samples,
    probabilities,
)
from pipeline.learn.perception_training.trainer import Samples, export_model, train_network
from pipeline.rig.radar_grid import sector_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_frames
from tests.makers.stages import perceive_day

DAY = Partition("car-1", "2026-03-02")
COLUMNS = {"radar_drivable_azimuth_rad", "radar_drivable_range_m"}


def fleet(file="fleet.toml", **radar):
    rig = THREE_SENSORS | {"radar": THREE_SENSORS["radar"] | radar}
    values = {"fleet": {"name": "made"}, "rigs": {"default": rig}, "vehicles": {"car-1": {}}}
    return FleetConfig.model_validate(values).read_from(Path(file))


MODEL = {"drivable": {"source": "onnx", "model": "radar_drivable.toml"}}


@pytest.fixture(scope="module")
def lake(tmp_path_factory, made_frame):
    """A lake with one drive of eight frames."""
    lake = Lake.at(tmp_path_factory.mktemp("drive") / "lake")
    write_frames(lake, DAY, [made_frame(i) for i in range(8)], "frames-key")
    return lake


def rows(lake):
    return list(observations_of(lake, DAY))


def test_a_network_taught_by_a_days_lidar_tells_the_days_radar_where_the_road_is(lake, tmp_path):
    torch.set_num_threads(1)
    file = tmp_path / "fleet.toml"
    geometric_key = perceive_day(DAY, fleet(file), lake).work_key
    before = rows(lake)
    samples = day_samples(before, np.eye(4), 8)
    training = DrivableTraining(steps=30, batch_size=4, width=8)
    network, _ = train_network(RadarDrivable, Samples(samples, samples, {}), tmp_path / "run", training)
    export_model(RadarDrivable, network, samples, tmp_path, {})
    result = perceive_day(DAY, fleet(file, **MODEL), lake)
    assert result.status == "done"  # not taken from the cache of the geometric one
    assert result.work_key != geometric_key
    after = rows(lake)
    # What perception feeds the model while it goes through frames is what training made of its rows.
    for row, p in zip(after, probabilities(network, samples), strict=True):
        azimuth, range_m = sector_of(p)
        assert np.array_equal(row.radar_drivable_azimuth_rad, azimuth)
        assert np.mean(row.radar_drivable_range_m == range_m) > 0.95  # samples are of half precision
        ahead = np.abs(azimuth) < np.radians(5)
        aside = np.abs(np.abs(azimuth) - np.radians(50)) < np.radians(5)
        assert np.median(range_m[ahead]) > np.median(range_m[aside])
    for a, b in zip(before, after, strict=True):
        for name in {f.name for f in fields(Observation)} - COLUMNS - {"priors"}:
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert perceive_day(DAY, fleet(file, **MODEL), lake).status == "cached"
    assert perceive_day(DAY, fleet(file), lake).work_key == geometric_key
    for a, b in zip(before, rows(lake), strict=True):
        assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in COLUMNS)


def test_the_network_that_ships_is_named_by_a_word_and_tells_free_ranges(lake):
    shipped = {"drivable": {"source": "onnx", "model": "shipped:radar_drivable"}}
    perceive_day(DAY, fleet(), lake)
    before = [r.radar_drivable_range_m for r in rows(lake)]
    assert perceive_day(DAY, fleet(**shipped), lake).status == "done"
    after = [r.radar_drivable_range_m for r in rows(lake)]
    assert all(len(r) and np.isfinite(r).all() and (r >= 0).all() and (r <= 80).all() for r in after)
    assert any(len(a) != len(b) or not np.allclose(a, b) for a, b in zip(after, before, strict=True))
