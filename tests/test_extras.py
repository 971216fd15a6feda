"""A plain install holds what the night needs; other commands name the extra that they lack."""

import json
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from jobs.cli import COMMANDS
from tests.test_imports import imports_of

REPO = Path(__file__).resolve().parent.parent
PACKAGES = ("jobs", "pipeline", "schemas")
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
# Where the import name differs.
DISTRIBUTION_OF = {
    "cv2": "opencv-python-headless", "foxglove": "foxglove-sdk", "google": "protobuf",
    "mcap_protobuf": "mcap-protobuf-support", "ruamel": "ruamel.yaml",
}  # fmt: skip
# Commands beyond the night: the extra that each needs, and its options as a person would give them. The folders need
# not exist, since the extra is asked for first.
NEEDS = {
    "demo": ("simulate", []),
    "simulate": ("simulate", ["--out", "logs"]),
    "train": ("train", ["--data", "lake", "--out", "run"]),
    "export": ("train", ["onnx", "--out", "a.onnx", "--run", "."]),
    "view": ("view", ["--lake", "lake", "--vehicle", "v", "--day", "2026-03-02"]),
}
# What only an option of a command imports, and asks for before anything is read: `--executor ray`, `--metrics` ...
OPTIONAL = {"av", "foxglove", "ray", "prometheus_client"}


def declared(*extras):
    """Import names of what `pip install boresight[extras]` asks for."""
    wanted = [*PROJECT["dependencies"], *(d for e in extras for d in PROJECT["optional-dependencies"][e])]
    names = {Requirement(d).name for d in wanted}
    called = {distribution: name for name, distribution in DISTRIBUTION_OF.items()}
    return {called.get(n, n.replace("-", "_")) for n in names}


@cache
def imported_by(module):
    """What a module of ours imports; nothing for a name inside a module."""
    path = REPO.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return imports_of(path) if path.is_file() else set()


@cache
def reached(command):
    """Our modules that a command may import, and the packages of others that those import."""
    ours, others, waiting = set(), set(), [COMMANDS[command][0].partition(":")[0]]
    while waiting:
        name = waiting.pop()
        top = name.split(".")[0]
        if top not in PACKAGES:
            others |= {top} - set(sys.stdlib_module_names)
        elif name not in ours:
            ours.add(name)
            waiting += [name.rpartition(".")[0]] if "." in name else []
            waiting += imported_by(name)
    return ours, others


@pytest.mark.parametrize("command", [c for c in COMMANDS if c not in NEEDS])
def test_a_plain_install_holds_all_that_a_command_of_the_night_may_import(command):
    assert reached(command)[1] <= declared() | OPTIONAL


@pytest.mark.parametrize("command", NEEDS)
def test_an_extra_holds_all_else_that_its_commands_may_import(command):
    assert reached(command)[1] - declared(NEEDS[command][0]) <= OPTIONAL


def test_nothing_is_declared_that_nothing_imports():
    imported = set().union(*(reached(command)[1] for command in COMMANDS))
    declared_for_users = declared("simulate", "train", "ray", "ops", "video", "viz", "view")
    assert declared_for_users - imported == {"tensorboard"}  # imported by torch.utils.tensorboard


@pytest.mark.parametrize(
    ("option", "value", "extra"), [("--executor", "ray", "ray"), ("--metrics", "a.prom", "ops")]
)
def test_an_option_without_its_extra_says_so_before_anything_is_read(option, value, extra):
    code = (
        f"import sys; sys.modules |= dict.fromkeys({OPTIONAL}); from jobs.cli import main;"
        "sys.exit(main(['nightly', '--fleet', 'f.toml', '--lake', 'l', '--logs', '*', *sys.argv[1:]]))"
    )
    command = [sys.executable, "-c", code, option, value]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPO)
    assert done.returncode == 2
    assert f"pip install 'boresight[{extra}]'" in done.stderr


@pytest.fixture(scope="module")
def ends_without_extras(tmp_path_factory):
    """How each call ends where no extra is installed: exit code and what stderr says."""
    code = (
        "import io, json, sys; from contextlib import redirect_stderr, redirect_stdout;"
        "sys.modules |= dict.fromkeys(['embreex', 'open3d', 'torch', 'ray', 'tensorboard']);"
        "from jobs.cli import main\n"
        "for name, call in json.loads(sys.argv[1]).items():\n"
        "    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:\n"
        "        ended = main(call)\n"
        "    print(json.dumps([name, ended, said.getvalue()]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps({name: [name, *call] for name, (_, call) in NEEDS.items()})],
        cwd=tmp_path_factory.mktemp("empty"),
        env={"PYTHONPATH": str(REPO), "PATH": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    return {name: (ended, said) for name, ended, said in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("command", NEEDS)
def test_a_command_without_its_extra_says_in_one_line_how_to_have_it(command, ends_without_extras):
    ended, said = ends_without_extras[command]
    assert ended == 2
    assert len(said.splitlines()) == 1
    assert f"pip install 'boresight[{NEEDS[command][0]}]'" in said
