"""Tasks on a Ray cluster of two nodes: workers and nodes die in the middle, and nothing is lost."""

import time
from contextlib import closing
from pathlib import Path

import pytest

import pipeline.fleet.ray_tasks
from pipeline.core.errors import ConfigError, MissingExtraError
from pipeline.fleet.executor import EXECUTORS
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


def until(happened, seconds=1800.0):
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("nodes")
def test_a_killed_worker_costs_its_own_item_only_and_is_retried_within_bounds(behave, tmp_path):
    seen = []
    kinds = ["a", "die-always", "b", "die-once", "raise-1", "greedy", "wait-2"]
    found = ends_of(behave, kinds, tmp_path, watch=lambda *at: seen.append(at))
    assert {k for k, f in found.items() if f.error} == {"die-always", "raise-1", "greedy"}
    assert "needed more than 0.25 GB of memory" in found["greedy"].error
    assert found["raise-1"].error == "RuntimeError: poisoned raise-1"
    assert "jobs_for_workers" in found["raise-1"].trace
    assert "killed" in found["die-always"].error
    tried = {kind: tries(tmp_path, kind) for kind in kinds}
    assert tried == dict.fromkeys(kinds, 1) | {"die-always": 3, "die-once": 2}  # once in company, then alone
    assert (6, 1, 2, "wait-2 at work") in seen


@pytest.mark.slow
@pytest.mark.usefixtures("nodes")
def test_who_stops_early_lets_tasks_put_their_things_away(behave, tmp_path):
    items = [("a", str(tmp_path)), ("sleep-1", str(tmp_path))]
    with closing(ray_tasks(behave, items, None, lambda *_: None)) as ends:
        next(ends)
        until((tmp_path / "sleep-1.tmp").exists)
    until(lambda: not (tmp_path / "sleep-1.tmp").exists())


@pytest.mark.slow
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
    small["Resources"]["memory"] = 1e12
    assert ends_of(behave, ["wait-2"], tmp_path)["wait-2"].value


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
