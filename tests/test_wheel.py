"""A stranger's machine: the wheel in an empty environment, in an empty folder, away from the checkout."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from dockerfile_parse import DockerfileParser

from tests.makers.loaded_libraries import foreign, loaded, tracing

REPO = Path(__file__).resolve().parent.parent
SMALL = ["--vehicles", "1", "--days", "1", "--frames", "12"]  # of 6 the network refuses to speak
DOCKERFILE = REPO / "jobs" / "deploy" / "Dockerfile"


def pip(*arguments):
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    return subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    code = f"import hatchling.build, os; os.chdir({str(REPO)!r}); print(hatchling.build.build_wheel({str(folder)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return folder / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def stranger(wheel, tmp_path_factory, pytestconfig):
    """Python of an environment that holds nothing but the wheel, what it asks for, and the extra [simulate]."""
    wanted = ["-c", "constraints.txt", f"{wheel}[simulate]"]
    kept = pytestconfig.cache.mkdir("wheels")  # of others, so that only the first run downloads them
    environment = tmp_path_factory.mktemp("stranger") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    into = ["--python", str(environment / "bin" / "python"), "install", "--no-compile", "--no-index"]
    if pip(*into, "--find-links", str(kept), *wanted).returncode:
        fetched = pip("download", "--quiet", "--dest", str(kept), *wanted)
        if fetched.returncode and not os.environ.get("CI"):
            pytest.skip(
                "no package index can be reached, and its wheels are not kept here: run it with a network"
            )
        assert fetched.returncode == 0, fetched.stderr[-3000:]
        installed = pip(*into, "--find-links", str(kept), *wanted)
        assert installed.returncode == 0, installed.stderr[-3000:]
    return environment / "bin" / "python"


def boresight(python, folder, *arguments):
    """Run the installed command where no checkout is near; its summary, its exit code and what it says."""
    environment = tracing(folder / "libraries") | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment = {k: v for k, v in environment.items() if k != "PYTHONPATH"}
    # Nothing here is about speed: compile the loops as cheaply as can be.
    environment["NUMBA_OPT"] = "0"
    done = subprocess.run(
        [python.parent / "boresight", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1]), done.returncode, done.stderr


@pytest.fixture(scope="module")
def demo(stranger, tmp_path_factory):
    folder = tmp_path_factory.mktemp("empty")
    return folder, boresight(stranger, folder, "demo", *SMALL)


@pytest.fixture(scope="module")
def night(stranger, demo, tmp_path_factory):
    """The demo's logs by the shipped network, after the extra has been taken away again."""
    removed = pip("--python", str(stranger), "uninstall", "--yes", "embreex")
    assert removed.returncode == 0, removed.stderr
    folder = tmp_path_factory.mktemp("night")
    logs = str(demo[0] / "demo" / "logs" / "{vehicle}" / "{day}" / "*")
    fleet = str(demo[0] / "demo" / "fleet.toml")
    call = ["nightly", "--fleet", fleet, "--lake", "lake", "--logs", logs, "--method", "joint-ssl"]
    return folder, boresight(stranger, folder, *call)


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel(demo):
    folder, (summary, code, said) = demo
    assert code in (0, 3), said[-3000:]
    assert summary["vehicle_days"] == 1
    assert (folder / summary["report"]).read_text().startswith("<!doctype html>")
    errors = json.loads((folder / summary["comparison"]).read_text())
    assert {e["method"] for e in errors} == {"joint", "joint-ssl"}


@pytest.mark.slow
def test_the_night_runs_from_a_plain_install_the_network_too(night, stranger):
    folder, (summary, code, said) = night
    assert code in (0, 3), said[-3000:]
    assert (summary["vehicle_days"], summary["failed"], summary["refused"]) == (1, 0, 0)
    assert list(folder.rglob("calibrations/**/*.parquet"))
    modules = "import importlib.util as u; print([m for m in ('torch', 'embreex', 'ray') if u.find_spec(m)])"
    found = subprocess.run([stranger, "-I", "-c", modules], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.slow
@pytest.mark.usefixtures("night")
def test_without_its_extra_the_installed_demo_names_it(stranger, tmp_path):
    summary, code, _ = boresight(stranger, tmp_path, "demo")
    assert code == 2
    assert "pip install 'boresight[simulate]'" in summary["reason"]


@pytest.mark.slow
@pytest.mark.parametrize("run", ["demo", "night"])
def test_a_stranger_loads_no_library_that_a_bare_system_lacks(run, stranger, request, tmp_path):
    folder, _ = request.getfixturevalue(run)
    libraries, processes = loaded(folder / "libraries")
    assert processes >= 2  # itself and a worker
    assert any("onnxruntime" in path for path in libraries)
    assert foreign(libraries, tmp_path, stranger) == set()


def test_a_library_of_the_desktop_is_foreign_and_the_c_library_is_not(tmp_path):
    inside = f"{sys.prefix}/lib/python3.11/site-packages/a.libs/libusb-1.0.so.0"
    system = {"/usr/lib/x86_64-linux-gnu/libusb-1.0.so.0", "/lib/x86_64-linux-gnu/libX11.so.6"}
    assert foreign(system | {"/lib/x86_64-linux-gnu/libc.so.6", inside}, tmp_path) == system


@pytest.mark.slow
def test_the_environment_of_a_night_is_smaller_than_1200_megabytes(stranger):
    files = [p for p in stranger.parent.parent.rglob("*") if p.is_file() and not p.is_symlink()]
    assert sum(p.stat().st_size for p in files) < 1.2e9


def test_the_container_holds_the_wheel_and_no_extra_and_runs_as_nobody_in_particular():
    steps = DockerfileParser(path=str(DOCKERFILE)).structure
    said = [(s["instruction"], s["value"]) for s in steps if s["instruction"] != "COMMENT"]
    of = dict(said)  # the last one of each counts
    assert {value.split()[0] for name, value in said if name == "FROM"} == {"python:3.11-slim"}
    assert of["ENTRYPOINT"] == '["boresight"]'
    assert of["USER"] == "boresight"
    assert "boresight" in of["HEALTHCHECK"]
    last = [i for i, (name, _) in enumerate(said) if name == "FROM"][-1]
    installs = [v for n, v in said[last:] if n == "RUN" and "pip install" in v]
    assert len(installs) == 1
    # The same line as `stranger`, without an extra.
    assert re.search(
        r"pip install --no-cache-dir -c /wheels/constraints\.txt /wheels/boresight-\*\.whl\s", installs[0]
    )
    copied = [v.split()[:-1] for n, v in said if n == "COPY" and "--from" not in v]
    assert all((REPO / source).exists() for sources in copied for source in sources)
