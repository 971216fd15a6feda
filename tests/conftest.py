"""Fixtures that several rooms share."""

import os
from collections import Counter
from collections.abc import Generator
from pathlib import Path

# One thread per process: the suite may run on several workers, and nested thread pools starve small machines.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import pytest  # noqa: E402 - numeric libraries read the environment while they are imported
from hypothesis import settings  # noqa: E402

from tests.budgets import BUDGETS, beyond, slowness  # noqa: E402
from tests.makers.s3_server import S3, running  # noqa: E402

# No deadline: the machine may be busy. The same examples each time: a red run must come again when it is looked at.
settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")

REPO = Path(__file__).resolve().parent.parent
SHARED = REPO.parent / "shared"


def shared(path: str) -> Path:
    """A folder or file of the shared data; the test is left out where they are absent."""
    if not (SHARED / path).exists():
        pytest.skip(f"the shared {path} is not on this machine")
    return SHARED / path


@pytest.fixture(scope="session")
def real_logs() -> Path:
    """Folder with the recordings of the real vehicle-day."""
    return shared("data/astyx")


@pytest.fixture(scope="session")
def kitti_logs() -> Path:
    """Folder with the recording of a street of KITTI."""
    return shared("data/kitti")


@pytest.fixture(scope="session")
def van_logs() -> Path:
    """Folder with a day of another simulator's van: two radars, two cameras, a lidar, odometry."""
    return shared("data/other_van")


@pytest.fixture(scope="session")
def real_detector() -> Path:
    """A real third-party ONNX detector."""
    return shared("models/yolox_nano.onnx")


@pytest.fixture(scope="session")
def real_segmenter() -> Path:
    """The real third-party ONNX segmenter that made the logged labels."""
    return shared("models/espnetv2_city.onnx")


@pytest.fixture(scope="session")
def s3_server() -> Generator[S3]:
    """A server of a bucket on loopback, for all of this process."""
    with running() as server:
        yield server


@pytest.fixture
def s3(s3_server: S3, monkeypatch: pytest.MonkeyPatch) -> Generator[S3]:
    """The server without faults, and this process set to use it."""
    from pipeline.store import object_store  # not before the shape checks hook the product's imports

    for name, value in s3_server.environment.items():
        monkeypatch.setenv(name, value)
    object_store._client.cache_clear()
    s3_server.faults(fail=0, stall=0)
    yield s3_server
    s3_server.faults(fail=0, stall=0)
    object_store._client.cache_clear()


# Where the heavy files are, so that no worker begins one when the other has nothing left. Others keep their order.
# While the first compiles the loops of the checkout, the second compiles those of the wheel, not the same ones.
HEAVIEST_FIRST = (
    "accuracy", "test_wheel.py", "end_to_end", "learn", "calibrate", "jobs", "simulate", "verify",
)  # fmt: skip


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Under xdist, which hands out files in the order of their first tests, begin with the heavy rooms."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        rank = {name: i for i, name in enumerate(HEAVIEST_FIRST)}
        items.sort(key=lambda item: rank.get(item.path.relative_to(REPO / "tests").parts[0], len(rank)))


# `make test` promises tests of less than ten seconds each. On a busy machine the same work takes more CPU time, and the
# first test of a process pays for imports and compiled loops.
QUICK_CPU_S = 15.0
COST = "cpu_s"
BEGAN_CPU_S = pytest.StashKey[float]()
BEYOND = pytest.StashKey[list[str]]()


def cpu_s() -> float:
    """CPU time of this process and of the children it has waited for: wall time would name busy machines."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Begin to count what a test costs, its fixtures included."""
    item.stash[BEGAN_CPU_S] = cpu_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note on the report of a test without the mark `slow` what it cost (workers send their reports)."""
    report = yield
    if report.when == "call" and "slow" not in item.keywords:
        report.user_properties.append((COST, cpu_s() - item.stash[BEGAN_CPU_S]))
    return report


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say last, and without being asked, which tests were left out and how to have them, and which are too slow."""
    left_out: Counter[tuple[str, str]] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, (tuple, list)) else str(report.longrepr)
        left_out[report.nodeid.partition("::")[0], reason.removeprefix("Skipped: ")] += 1
    for (file, reason), tests in sorted(left_out.items()):
        terminalreporter.write_line(f"left out of {file}: {tests} ({reason})")
    costs = cpu_s_of_tests(terminalreporter)
    for test, cost in sorted(costs.items(), key=lambda item: -item[1]):
        if cost > QUICK_CPU_S:
            terminalreporter.write_line(f"not quick, and not marked slow: {test} ({cost:.0f} s of CPU)")
    for folder, cost in sorted(cpu_s_of_folders(costs).items(), key=lambda item: -item[1]):
        terminalreporter.write_line(f"quick tests of {folder}: {cost:.0f} s of CPU")
    for sentence in terminalreporter.config.stash.get(BEYOND, []):
        terminalreporter.write_line(f"CPU seconds of the quick tests of {sentence}")


def cpu_s_of_tests(reporter: pytest.TerminalReporter) -> dict[str, float]:
    """What each test without the mark `slow` cost."""
    reports = [*reporter.stats.get("passed", []), *reporter.stats.get("failed", [])]
    return {r.nodeid: value for r in reports for name, value in r.user_properties if name == COST}


def cpu_s_of_folders(costs: dict[str, float]) -> Counter[str]:
    """Their sums by folder of tests/."""
    sums: Counter[str] = Counter()
    for test, cost in costs.items():
        folder = Path(test.partition("::")[0]).parts[1]
        sums["files beside the folders" if folder.endswith(".py") else folder] += cost
    return sums


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where the quick tests of a folder cost more than their budget, in CPU time of the machine of the budgets.

    A part of the suite costs less than the whole, and the budgets are of a run with shape checks: every run is asked.
    """
    reporter = session.config.pluginmanager.getplugin("terminalreporter")
    if hasattr(session.config, "workerinput") or reporter is None:
        return
    machine = max(1.0, slowness())  # a fast moment proves nothing about the minutes before it
    folders = {n: cost / machine for n, cost in cpu_s_of_folders(cpu_s_of_tests(reporter)).items()}
    session.config.stash[BEYOND] = beyond(folders, BUDGETS["quick_cpu_s"])
    if session.config.stash[BEYOND] and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
