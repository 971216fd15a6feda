"""Training on a Ray cluster of this machine: two workers, and their errors as ours. Needs the extra [train-ray]."""

import pickle

import pytest

from pipeline.errors import BoresightError, ConfigError, ContractError, LogError, SolveError
from pipeline.learn.train.ray import train_on_ray
from pipeline.learn.train.run import TrainRequest
from pipeline.learn.train.run_state import network_of_run
from pipeline.learn.train.schedule import DivergedError
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake
from tests.makers.training_lakes import fill, fleet_of, prepare_all

CONFIG = TrainConfig(steps=2, batch_size=1, width=4, hidden=8, validation_frames=2)


@pytest.fixture(scope="module")
def cluster():
    """A cluster of this machine alone, as small as training needs."""
    missing = "the extra [train-ray] is not installed: pip install 'boresight[train-ray]'"
    pytest.importorskip("ray.train", reason=missing, exc_type=ImportError)
    import ray

    ray.init(num_cpus=4, include_dashboard=False, log_to_driver=False, configure_logging=False)
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("ray") / "lake"
    vehicles = [f"v{i}" for i in range(6)]
    for i, vehicle in enumerate(vehicles):
        fill(Lake.at(root), vehicle, f"2026-01-{i + 1:02d}", 4)
    prepare_all(Lake.at(root), fleet_of(vehicles, grid={"width_deg": 89.6, "height_deg": 51.2}))
    return str(root)


@pytest.mark.slow  # in processes of Ray, whose time is not counted as its own
@pytest.mark.usefixtures("cluster")
# Ray itself leaves files and sockets to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_two_workers_train_one_network_and_go_on_where_they_stopped(data, tmp_path):
    out = tmp_path / "run"
    stopped = train_on_ray(TrainRequest(data, out, "cpu", time_limit_s=1e-6), CONFIG, 2)
    assert (stopped.status, stopped.step) == ("time_limit", 0)
    result = train_on_ray(TrainRequest(data, out, "cpu"), CONFIG, 2)
    assert (result.status, result.step, result.samples) == ("done", 2, 4)  # two workers, one frame each
    assert network_of_run(out, best=False).config.width == 4
    # One worker cannot go on with what two began, and says so as it would without Ray.
    with pytest.raises(ConfigError, match="as many"):
        train_on_ray(TrainRequest(data, out, "cpu"), CONFIG, 1)


def test_errors_survive_the_way_between_processes():
    for error in (
        ConfigError("a.toml", "key", "wrong"), ContractError("path", "problem"), SolveError("reason"),
        LogError("a.mcap", "cut", topic="/t"), DivergedError(3, "nan"),
    ):  # fmt: skip
        again = pickle.loads(pickle.dumps(error))
        assert isinstance(again, BoresightError)
        assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))


def test_fewer_than_one_worker_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="below 1"):
        train_on_ray(TrainRequest("lake", tmp_path), CONFIG, 0)
