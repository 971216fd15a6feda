"""Scripts that no test runs: what they import has to be there all the same."""

import importlib
from pathlib import Path

import pytest

from tests.benchmarks import conftest

FOLDER = Path(conftest.__file__).parent
MODULES = [
    ".".join(("tests", "benchmarks", *path.relative_to(FOLDER).with_suffix("").parts))
    for path in sorted(FOLDER.rglob("*.py"))
]


@pytest.mark.parametrize("module", MODULES)
def test_every_benchmark_and_study_can_be_imported(module):
    importlib.import_module(module)
