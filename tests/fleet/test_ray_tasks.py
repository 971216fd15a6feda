"""Tasks on a Ray cluster of two nodes: workers and nodes die in the middle, and nothing is lost."""

import os
import time
from contextlib import closing
from pathlib import Path

import pytest

import pipeline.fleet.ray_tasks
from pipeline.core.errors import ConfigError, ContractError, MissingExtraError
from pipeline.fleet.executor import EXECUTORS
from pipeline.fleet.ray_tasks import _work
from tests.makers.ray_clusters import lasting, two_nodes

pytestmark = lasting
HERE = Path(__file__).resolve().parent
ray_tasks = EXECUTORS["ray"]


@pytest.fixture(scope="module")
def nodes():
    with two_nodes(HERE) as (cluster, nodes):
        yield cluster, nodes


def ends_of(behave, kinds, folder, workers=None, watch=lambda *_: None):
    items = [(kind, str(folder)) for kind in kinds]
    return {f.item[0]: f for f in ray_tasks(behave, items, workers, watch)}


def tries(folder, kind):
    return len((folder / f"{kind}.tries").read_text().split())


def until(happened, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


@pytest.mark.usefixtures("nodes")
def test_a_killed_worker_costs_its_own_item_only_and_is_retried_within_bounds(behave, tmp_path):
    seen = []
    kinds = ["a", "die-always", "b", "die-once", "raise-1", "wait-2"]
    found = ends_of(behave, kinds, tmp_path, watch=lambda *at: seen.append(at))
    assert {k for k, f in found.items() if f.error} == {"die-always", "raise-1"}
    assert found["raise-1"].error == "RuntimeError: poisoned raise-1"
    assert "jobs_for_workers" in found["raise-1"].trace
    assert "killed" in found["die-always"].error
    assert (tries(tmp_path, "die-always"), tries(tmp_path, "die-once")) == (
        3,
        2,
    )  # once in company, twice alone
    assert all(tries(tmp_path, kind) == 1 for kind in ("a", "b", "raise-1", "wait-2"))
    assert (5, 1, 2, "wait-2 at work") in seen


@pytest.mark.usefixtures("nodes")
def test_no_more_items_are_in_flight_than_there_are_workers(behave, tmp_path):
    class Items(list):
        def __getitem__(self, index):
            taken.append(index)
            return super().__getitem__(index)

    taken = []
    items = Items((kind, str(tmp_path)) for kind in ("a", "b", "c", "d"))
    with closing(ray_tasks(behave, items, 1, lambda *_: None)) as ends:
        next(ends)
        assert set(taken) <= {0, 1}


def test_a_lost_node_loses_nothing(nodes, behave, tmp_path):
    cluster, (node, *_) = nodes
    items = [(kind, str(tmp_path)) for kind in ("wait-1", "wait-2", "wait-3")]
    with closing(ray_tasks(behave, items, None, lambda *_: None)) as ends:
        found = [next(ends)]
        cluster.remove_node(node, allow_graceful=False)
        found += list(ends)
    assert sorted(f.value[0] for f in found) == [f"wait-{i} done" for i in (1, 2, 3)]


@pytest.mark.slow
@pytest.mark.usefixtures("nodes")
def test_who_is_there_whenever_a_node_goes_is_given_up_in_the_end_and_the_others_are_not(
    behave, tmp_path, monkeypatch
):
    class Errors:
        """What Ray would say if the node went with every try of one item."""

        def __init__(self, real):
            self.real = real

        def __call__(self, ref, *arguments):
            value = self.real(ref, *arguments)
            if getattr(value, "value", None) and value.value[0] == "b done":
                raise ray.exceptions.NodeDiedError("gone")
            return value

    import ray

    monkeypatch.setattr(ray, "get", Errors(ray.get))
    found = ends_of(behave, ["a", "b", "c"], tmp_path)
    assert {k for k, f in found.items() if f.error} == {"b"}
    assert tries(tmp_path, "b") == 5  # three nodes in company, two more alone


@pytest.mark.usefixtures("nodes")
def test_who_stops_early_lets_tasks_put_their_things_away(behave, tmp_path):
    items = [("a", str(tmp_path)), ("sleep-1", str(tmp_path))]
    with closing(ray_tasks(behave, items, None, lambda *_: None)) as ends:
        next(ends)
        until((tmp_path / "sleep-1.tmp").exists)
    until(lambda: not (tmp_path / "sleep-1.tmp").exists())


@pytest.mark.usefixtures("nodes")
def test_a_cluster_without_room_for_a_task_is_named_after_a_while(behave, tmp_path, monkeypatch):
    import ray

    monkeypatch.setattr(pipeline.fleet.ray_tasks, "_NO_NODE_S", 0.5)
    small = {"Alive": True, "Resources": {"CPU": 4, "memory": 1e9}}
    lost = {"Alive": False, "Resources": {"CPU": 4, "memory": 1e12}}
    monkeypatch.setattr(ray, "nodes", lambda: [small, lost])
    with pytest.raises(ConfigError, match="RAY_ADDRESS: no node of the cluster has 1 CPU and 2 GiB"):
        ends_of(behave, ["sleep-1"], tmp_path)
    assert not (tmp_path / "sleep-1.tmp").exists()


def test_another_version_on_a_node_is_named(behave, tmp_path):
    with pytest.raises(ContractError, match=r"the driver is of version 0\.0\.1"):
        _work(behave, ("a", str(tmp_path)), 0, None, "0.0.1")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere:port"])
def test_a_cluster_that_does_not_answer_is_named_at_once(address, behave, tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(ConfigError, match=f"no cluster at '{address}'"):
        ends_of(behave, ["a"], tmp_path)


def test_a_client_of_a_cluster_is_told_to_run_inside(behave, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "ray://head:10001")
    with pytest.raises(ConfigError, match="ray job submit"):
        ends_of(behave, ["a"], tmp_path)


def test_without_ray_the_extra_is_named(behave, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"boresight\[ray\]"):
        ends_of(behave, ["a"], tmp_path)


def test_ray_is_told_to_report_to_nobody(nodes):
    del nodes
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
