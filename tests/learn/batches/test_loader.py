"""The loader's order is the seed's, resumes to the frame, and gives every rank its own."""

import numpy as np
import pytest
import torch

from pipeline.core.errors import ContractError
from pipeline.learn.batches.loader import TrainingLoader, load_split
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.store.partitions import Partition
from pipeline.store.tables import read_rows
from schemas.training import TRAINING, TrainingRow
from tests.makers import training_lakes
from tests.makers.stages import prepare_day

VEHICLES = ("a", "b", "c", "d", "e", "f")


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Six vehicles, 10 frames each in row groups of 4 (the writer's 16 would leave a group per vehicle)."""
    lake = training_lakes.fleet_lake(tmp_path_factory.mktemp("lake"), VEHICLES, frames=10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.store.tables._GROUP_ROWS", 4)
        training_lakes.prepare_all(lake, training_lakes.fleet_of(VEHICLES, by=["vehicle"]))
    return lake


def names(batch):
    return list(zip(batch.vehicle, batch.frame_index.tolist(), strict=True))


def taken(loader, batches):
    return [names(next(loader)) for _ in range(batches)]


@pytest.mark.slow
def test_an_epoch_shows_every_frame_once_in_another_order_each_time(lake):
    loader = TrainingLoader(lake, 4, window_groups=3)
    assert loader.frames == 40
    epochs = [[n for b in taken(loader, loader.frames // 4) for n in b] for _ in range(3)]
    assert all(sorted(e) == sorted(epochs[0]) and len(set(e)) == 40 for e in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    neighbours = np.mean([a[0] == b[0] for a, b in zip(epochs[0], epochs[0][1:], strict=False)])
    assert neighbours < 0.75  # in order it would be 0.92


@pytest.mark.parametrize("after", [1, 13])
def test_a_resumed_loader_continues_as_if_nothing_had_happened(lake, after):
    whole = TrainingLoader(lake, 3, seed=4, window_groups=2)
    begun = TrainingLoader(lake, 3, seed=4, window_groups=2)
    taken(begun, after)
    state = begun.state_dict()
    taken(begun, 2)  # what was read ahead does not count
    resumed = TrainingLoader(lake, 3, seed=4, window_groups=2)
    resumed.load_state_dict(state)
    taken(whole, after)
    for _ in range(16):  # beyond the end of the epoch
        a, b = next(whole), next(resumed)
        assert names(a) == names(b)
        assert all(
            torch.equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
            if isinstance(x, torch.Tensor)
        )  # fmt: skip


def first_epoch(loader):
    """Names of the frames until the second epoch begins; batches of one frame."""
    seen = []
    for batch in loader:
        if loader.state_dict()["epoch"]:
            return seen
        seen += names(batch)
    return seen


def test_ranks_share_the_frames_without_overlap(lake):
    shares = [first_epoch(TrainingLoader(lake, 1, rank_of=(r, 3), seed=9)) for r in range(3)]
    assert sorted(n for s in shares for n in s) == sorted(names(load_split(lake, "train")))
    assert min(len(s) for s in shares) >= 8


def test_a_batch_holds_what_the_rows_hold(lake):
    batch = load_split(lake, "test")
    (vehicle,) = set(batch.vehicle)
    rows = read_rows(lake, TRAINING, Partition(vehicle, "2026-01-01"), TrainingRow)
    assert len(batch) == len(rows) == 10
    row = rows[3]
    assert np.array_equal(batch.image[3].numpy().reshape(3, -1), row.image)
    assert np.array_equal(batch.edge_offset[3].numpy().reshape(4, -1), row.edge_offset)
    assert batch.lidar_valid[3].sum() == row.lidar_count
    assert not batch.lidar_xyz_m[3][~batch.lidar_valid[3]].any()
    assert batch.track_valid.sum(1).tolist() == [r.track_count for r in rows]
    assert batch.T_camera_lidar[3, 0, 3] == pytest.approx(row.reference_camera_lidar_tx_m)
    assert torch.allclose(batch.T_camera_lidar[:, :3, :3].det(), torch.ones(10))
    some = batch.take(torch.tensor([7, 3]))
    assert names(some) == [names(batch)[7], names(batch)[3]]
    assert torch.equal(some.image[1], batch.image[3])
    assert names(batch[2:4]) == names(batch)[2:4]
    assert batch.to("cpu").grid_class.dtype == torch.uint8


def test_a_changed_table_or_another_order_refuses_to_resume(lake, tmp_path):
    state = TrainingLoader(lake, 3, seed=1).state_dict()
    with pytest.raises(ContractError, match="other seed or processes"):
        TrainingLoader(lake, 3, seed=2).load_state_dict(state)
    other = training_lakes.fleet_lake(tmp_path, VEHICLES[:3], frames=3)
    training_lakes.prepare_all(other, training_lakes.fleet_of(VEHICLES, by=["vehicle"]))
    with pytest.raises(ContractError, match="changed"):
        TrainingLoader(other, 3, seed=1).load_state_dict(state)


def test_rows_of_two_grids_are_refused(tmp_path):
    other = training_lakes.fleet_lake(tmp_path, VEHICLES[:2], frames=2)
    for vehicle, step in zip(VEHICLES[:2], (0.4, 0.3), strict=True):
        fleet = training_lakes.fleet_of([vehicle], by=["vehicle"], val_fraction=0, grid={"step_deg": step})
        survey = survey_day(Partition(vehicle, "2026-01-01"), other, fleet.prepare)
        prepare_day(survey.partition, fleet, other, plan_days([survey], fleet.prepare, {}))
    with pytest.raises(ContractError, match="different grids"):
        load_split(other, "train")
