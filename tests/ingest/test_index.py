"""The first pass over a day's logs."""

import os
import resource

import pytest

from pipeline.core.config import load_fleet
from pipeline.ingest.index import index_logs
from tests.makers.fleet_files import fleet_toml


@pytest.fixture
def few_open_files():
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (128, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.usefixtures("few_open_files")
def test_a_day_in_more_logs_than_a_process_may_open_at_first_is_read_whole(kit, tmp_path):
    log = kit.Kit().drive().mcap(tmp_path / "0.mcap")
    logs = [log, *(tmp_path / f"{i}.mcap" for i in range(1, 200))]
    for other in logs[1:]:
        os.link(log, other)
    (tmp_path / "fleet.toml").write_text(fleet_toml("car"))
    index = index_logs(logs, load_fleet(tmp_path / "fleet.toml").rig_of("car"))
    assert (len(index.logs), index.problems) == (200, [])
    index.close()
