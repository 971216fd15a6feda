"""An empty lake for the tests of this room."""

import pytest

from pipeline.store.partitions import Lake


@pytest.fixture
def lake(tmp_path):
    return Lake.at(tmp_path / "lake")
