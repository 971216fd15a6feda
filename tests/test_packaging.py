"""The three folders are the import packages of one distribution; nothing else may own their generic names."""

import importlib.metadata
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPO = Path(__file__).resolve().parent.parent
PACKAGES = ("jobs", "pipeline", "schemas")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel as `pip wheel` makes it, without the network: the build backend is in the environment."""
    folder = tmp_path_factory.mktemp("wheel")
    code = f"import hatchling.build, os; os.chdir({str(REPO)!r}); print(hatchling.build.build_wheel({str(folder)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return zipfile.ZipFile(folder / done.stdout.split()[-1])


def test_the_three_names_resolve_to_one_parent_folder():
    import jobs
    import pipeline
    import schemas

    assert {Path(p.__file__).resolve().parent.parent for p in (jobs, pipeline, schemas)} == {REPO}


def test_the_command_is_installed():
    scripts = importlib.metadata.entry_points(group="console_scripts", name="boresight")
    assert [s.value for s in scripts] == ["jobs.cli:main"]


def test_a_wheel_holds_all_modules_and_data_files_and_nothing_else(wheel):
    names = {n for n in wheel.namelist() if ".dist-info/" not in n}
    listed = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=REPO, capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(listed) <= names
    assert any(n.startswith("pipeline/report/templates/") for n in names)
    assert {n.split("/")[0] for n in names} == set(PACKAGES)


def test_every_dependency_is_pinned_to_what_was_tested():
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(name for extra in extras for name in extra)]
    untested = {"onnxruntime-gpu"}  # no GPU runs the tests: a pin would claim that one did
    names = {Requirement(w).name.lower() for w in wanted} - {"boresight"} - untested
    lines = (REPO / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line and not line.startswith("#")}
    assert names <= pinned, names - pinned


def test_nothing_names_this_machine():
    tracked = subprocess.run(["git", "ls-files"], cwd=REPO, capture_output=True, text=True, check=True).stdout
    files = [p for p in tracked.split() if not p.startswith("tests/") and (REPO / p).is_file()]
    contents = {p: (REPO / p).read_bytes() for p in files}  # a network is no text, and names nothing either
    assert [p for p, content in contents.items() if b"/work/" in content or b"../shared" in content] == []


@pytest.mark.parametrize("target", ["setup", "demo", "test", "lint", "help"])
def test_make_has_the_targets_that_the_readme_promises(target):
    done = subprocess.run(["make", "help"], cwd=REPO, capture_output=True, text=True, check=True)
    assert target in {line.split()[0] for line in done.stdout.splitlines() if line}
