"""The maker of calibration records, for tests of the audit and of the pages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def maker() -> ModuleType:
    """The module tests/audit/fleet_records.py."""
    path = Path(__file__).parent.parent / "audit" / "fleet_records.py"
    spec = importlib.util.spec_from_file_location("fleet_records", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fleet_records"] = module
    spec.loader.exec_module(module)
    return module
