"""The three folders are the import packages of one distribution; its dependencies are pinned."""

import subprocess
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

REPO = Path(__file__).resolve().parent.parent
PACKAGES = ("jobs", "pipeline", "schemas")


def test_the_three_names_resolve_to_one_parent_folder():
    import jobs
    import pipeline
    import schemas

    assert {Path(p.__file__).resolve().parent.parent for p in (jobs, pipeline, schemas)} == {REPO}


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


def test_make_has_the_targets_that_the_readme_promises():
    done = subprocess.run(["make", "help"], cwd=REPO, capture_output=True, text=True, check=True)
    listed = {line.split()[0] for line in done.stdout.splitlines() if line}
    assert listed >= {"setup", "demo", "test", "lint", "help"}
