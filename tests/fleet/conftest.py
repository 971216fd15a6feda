"""What workers of tests do."""

import importlib.util
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent


@pytest.fixture
def behave(monkeypatch):
    # Spawned workers find the function by its module's name: they take sys.path from this process.
    monkeypatch.syspath_prepend(str(HERE))
    spec = importlib.util.spec_from_file_location("jobs_for_workers", HERE / "jobs_for_workers.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "jobs_for_workers", module)
    spec.loader.exec_module(module)
    return module.behave
