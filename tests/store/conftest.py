"""Lakes in a folder, and in a bucket of a server on loopback."""

import numpy as np
import pytest

from pipeline.store.partitions import Lake
from tests.makers.s3_server import BUCKET


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
