"""Fixtures of this room: small real logs, and the stage run on them."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.core.config import FleetConfig
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from tests.makers import written_logs
from tests.makers.stages import ingest_day


@pytest.fixture(scope="session")
def kit() -> SimpleNamespace:
    """Everything that the tests of this room write logs with."""
    short = {"fleet": "fleet_config", "lidar": "lidar_columns", "radar": "radar_columns"}
    named = vars(written_logs)
    return SimpleNamespace(**named, sqlite=sqlite3, **{name: named[whole] for name, whole in short.items()})


@pytest.fixture
def run_ingest(tmp_path):
    """Ingest logs into a fresh lake: (result, frames)."""

    def run(*logs: Path, fleet: FleetConfig | None = None, name: str = "lake", file: str = "fleet.toml"):
        lake, day = Lake.at(tmp_path / name), Partition("car", "2023-11-14")
        config = (fleet or written_logs.fleet_config()).read_from(Path(file))
        result = ingest_day(list(logs), day, config, lake)
        frames = list(frames_of(lake, day)) if result.rows else []
        return result, frames

    return run
