"""A stranger's machine: the wheel in an empty environment, in an empty folder, away from the checkout.

Which shared libraries a command loads, with all processes that it starts, glibc's loader tells itself (LD_DEBUG, see
ld.so(8)): one file per process, so no short-lived worker is missed.
"""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from dockerfile_parse import DockerfileParser

REPO = Path(__file__).resolve().parent.parent
SMALL = ["--vehicles", "1", "--days", "1", "--frames", "12"]  # of 6 the network refuses to speak
DOCKERFILE = REPO / "jobs" / "deploy" / "Dockerfile"


# The C and C++ runtime on the list of PEP 600 (manylinux_2_17; so also of PEP 513, 571 and 599). What else is on that
# list, libX11, libGL and libglib, belongs to a desktop: a bare Debian has none of it, so nothing may load it here.
ALWAYS_THERE = re.compile(
    r"ld-linux-(aarch64\.so\.1|x86-64\.so\.2)|lib(anl|c|dl|gcc_s|m|nsl|pthread|resolv|rt|stdc\+\+|util)\.so\.\d"
)
# Plugins of the resolver, which glibc loads as /etc/nsswitch.conf of that very machine tells it.
_CHOSEN_BY_THE_SYSTEM = re.compile(r"libnss_\w+\.so\.2")
_LOADED = re.compile(rb"calling init: (\S+)")
# Modules of the standard library that stand on a library of the system: such a library is the interpreter's own.
_OF_THE_INTERPRETER = "import bz2, ctypes, hashlib, lzma, pyexpat, sqlite3, ssl, uuid, zlib"


def tracing(folder):
    """Environment in which every process writes the libraries that it loads into a file of the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return os.environ | {"LD_DEBUG": "libs", "LD_DEBUG_OUTPUT": str(folder / "process")}


def loaded(folder):
    """Paths of all libraries that were loaded by processes run in `tracing(folder)`, and the number of these."""
    files = list(folder.glob("process.*"))
    return {m.decode() for f in files for m in _LOADED.findall(f.read_bytes())}, len(files)


def foreign(paths, folder, python=sys.executable):
    """Those of the paths that neither the environment of `python`, its interpreter nor a bare system brings.

    Args:
        paths: of shared libraries.
        folder: to trace the interpreter in.
        python: of the environment that loaded them.
    """
    subprocess.run([python, "-I", "-c", _OF_THE_INTERPRETER], env=tracing(folder), check=True)
    own = {Path(p).resolve() for p in loaded(folder)[0]}
    code = "import sys; print(sys.prefix, sys.base_prefix, sep='\\n')"
    told = subprocess.run([python, "-I", "-c", code], capture_output=True, text=True, check=True).stdout
    # An interpreter in /usr does not make all of /usr its own.
    homes = [Path(h).resolve() for h in told.splitlines() if Path(h) not in (Path("/usr"), Path("/"))]
    return {
        p
        for p in paths
        if not ALWAYS_THERE.fullmatch(Path(p).name)
        and not _CHOSEN_BY_THE_SYSTEM.fullmatch(Path(p).name)
        and Path(p).resolve() not in own
        and not any(Path(p).resolve().is_relative_to(h) for h in homes)
        and not re.search(r"/python3\.\d+/lib-dynload/|/libpython3", p)
    }


def pip(*arguments):
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    return subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    code = f"import hatchling.build, os; os.chdir({str(REPO)!r}); print(hatchling.build.build_wheel({str(folder)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return folder / done.stdout.split()[-1]


def test_a_wheel_holds_all_modules_and_data_files_and_nothing_else(wheel):
    names = {n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n}
    packages = {"jobs", "pipeline", "schemas"}
    listed = subprocess.run(
        ["git", "ls-files", *packages], cwd=REPO, capture_output=True, text=True, check=True
    )
    assert set(listed.stdout.split()) <= names
    assert any(n.startswith("pipeline/report/templates/") for n in names)
    assert {n.split("/")[0] for n in names} == packages


@pytest.fixture(scope="module")
def stranger(wheel, tmp_path_factory):
    """Python of an environment that holds nothing but the wheel, what it asks for, and the extra [simulate]."""
    python = tmp_path_factory.mktemp("stranger") / "venv" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(python.parent.parent)], check=True)
    wanted = ["--no-compile", "-c", "constraints.txt", f"{wheel}[simulate]"]
    installed = pip("--python", str(python), "install", "--quiet", *wanted)
    if installed.returncode and not os.environ.get("CI"):
        pytest.skip("no package index can be reached: run it with a network")
    assert installed.returncode == 0, installed.stderr[-3000:]
    return python


def boresight(python, folder, *arguments):
    """Run the installed command where no checkout is near; its summary, its exit code and what it says."""
    environment = tracing(folder / "libraries") | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment = {k: v for k, v in environment.items() if k != "PYTHONPATH"}
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
    """The demo's logs, after the extra has been taken away again."""
    removed = pip("--python", str(stranger), "uninstall", "--yes", "embreex")
    assert removed.returncode == 0, removed.stderr
    folder = tmp_path_factory.mktemp("night")
    logs = str(demo[0] / "demo" / "logs" / "{vehicle}" / "{day}" / "*")
    fleet = str(demo[0] / "demo" / "fleet.toml")
    call = ["nightly", "--fleet", fleet, "--lake", "lake", "--logs", logs]
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
def test_the_night_runs_from_a_plain_install(night, stranger):
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
def test_a_stranger_loads_no_library_that_a_bare_system_lacks(demo, stranger, tmp_path):
    libraries, processes = loaded(demo[0] / "libraries")
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
