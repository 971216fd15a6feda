"""Fixtures that several rooms share."""

import os
from pathlib import Path

# One thread per process: the suite may run on several workers, and nested thread pools starve small machines.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import pytest  # noqa: E402 - numeric libraries read the environment while they are imported
from hypothesis import settings  # noqa: E402

# No deadline: the machine may be busy. The same examples each time: a red run must come again when it is looked at.
settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")

REPO = Path(__file__).resolve().parent.parent
SHARED = REPO.parent / "shared"


@pytest.fixture(scope="session")
def real_logs() -> Path:
    """Folder with the recordings of the real vehicle-day."""
    folder = SHARED / "data" / "astyx"
    if not folder.is_dir():
        pytest.skip("the real recordings are not on this machine")
    return folder


@pytest.fixture(scope="session")
def real_detector() -> Path:
    """A real third-party ONNX detector."""
    path = SHARED / "models" / "yolox_nano.onnx"
    if not path.is_file():
        pytest.skip("the real detector is not on this machine")
    return path
