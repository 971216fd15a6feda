"""Lakes in a folder, and in a bucket of a server on loopback."""

from collections.abc import Iterator

import numpy as np
import pytest

import pipeline.store.object_store
from pipeline.store.partitions import Lake
from tests.makers.s3_server import BUCKET, running


@pytest.fixture(scope="session")
def server() -> Iterator[object]:
    """The server, for all of this process."""
    with running() as s3:
        yield s3


@pytest.fixture
def s3(server: object, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """The server without faults, and this process set to use it."""
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    pipeline.store.object_store._client.cache_clear()
    server.faults(fail=0, stall=0)
    yield server
    pipeline.store.object_store._client.cache_clear()


@pytest.fixture
def lake(tmp_path: object) -> Lake:
    """An empty lake in a folder."""
    return Lake.at(tmp_path / "lake")


@pytest.fixture
def bucket_lake(s3: object, request: pytest.FixtureRequest) -> Lake:
    """An empty lake in the bucket."""
    assert s3.url  # its environment comes first
    return Lake.at(f"s3://{BUCKET}/lakes/{abs(hash(request.node.name))}")


@pytest.fixture(params=["folder", "bucket"])
def any_lake(request: pytest.FixtureRequest) -> Lake:
    """An empty lake, in each place where one can be."""
    return request.getfixturevalue("lake" if request.param == "folder" else "bucket_lake")


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same for each test."""
    return np.random.default_rng(0)
