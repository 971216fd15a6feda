"""The maker of calibration records, for tests of the audit and of the pages."""

from types import ModuleType

import pytest

from tests.audit import fleet_records


@pytest.fixture(scope="session")
def maker() -> ModuleType:
    """The module tests/audit/fleet_records.py."""
    return fleet_records
