"""Ray clusters of several nodes' worth of processes on this machine; for tests that end nodes in the middle."""

import os
from contextlib import contextmanager

import pytest

__all__ = ["MISSING", "another_node", "lasting", "ray_or_skip", "two_nodes"]

MISSING = "the extra [ray] is not installed: pip install 'boresight[ray]'"
# Ray itself leaves files and sockets to the garbage collector.
lasting = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]
_NODE = {"object_store_memory": 80 << 20, "include_dashboard": False}  # Ray's least is 75 MiB


def ray_or_skip():
    """The module; the test is left out where it is not installed."""
    return pytest.importorskip("ray", reason=MISSING)


def another_node(cluster):
    """A node of one CPU that joins the cluster."""
    return cluster.add_node(num_cpus=1, **_NODE)


@contextmanager
def two_nodes(*importable):
    """A head without work and two nodes of one CPU, in $RAY_ADDRESS: the cluster, and its two nodes.

    Args:
        importable: folders that workers import from, besides those that this process imports from.
    """
    ray = ray_or_skip()
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_AUTH_TOKEN", "test" * 8)  # Ray keeps the first one of a process
    ours = {
        "RAY_USAGE_STATS_ENABLED": "0",
        "PYTHONPATH": os.pathsep.join([*map(str, importable), os.environ.get("PYTHONPATH", "")]),
    }
    before = {name: os.environ.get(name) for name in (*ours, "RAY_ADDRESS")}
    os.environ.update(ours)
    cluster = Cluster(initialize_head=True, head_node_args=_NODE | {"num_cpus": 0})
    try:
        nodes = [another_node(cluster) for _ in range(2)]
        os.environ["RAY_ADDRESS"] = cluster.address
        yield cluster, nodes
    finally:
        ray.shutdown()
        cluster.shutdown()
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
