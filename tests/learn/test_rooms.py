"""The rooms of pipeline/learn: each stands on earlier ones only, and inference reaches no torch."""

import ast
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
LEARN = REPO / "pipeline" / "learn"
# What each room may import of the others: data travels from left to right.
STANDS_ON = {
    "sample": set(),
    "prepare": {"sample"},
    "frames": {"prepare"},
    "batches": {"sample", "prepare"},
    "network": {"sample", "batches"},
    "train": {"sample", "prepare", "batches", "network"},
    "export": {"sample", "network", "train", "infer"},
    "infer": {"sample"},
    "perception_training": {"prepare", "train", "export"},
}


def imported_by(path):
    """Names of the modules that a file imports, at its top or inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def file_of(module):
    """Source of one of our own modules; None for a package of others, or a name inside a module."""
    path = REPO.joinpath(*module.split("."))
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.exists()), None)


def reached_from(paths):
    """Names of all modules that these files import, directly or through our own modules."""
    waiting, seen, names = list(paths), set(), set()
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen.add(path)
        found = set(imported_by(path))
        names |= found
        waiting += [p for p in map(file_of, found) if p is not None]
    return names


def test_every_room_is_named_here():
    assert {p.parent.name for p in LEARN.glob("*/__init__.py")} == set(STANDS_ON)


@pytest.mark.parametrize("room", STANDS_ON)
def test_a_room_stands_on_earlier_rooms_only(room):
    names = {name for path in (LEARN / room).rglob("*.py") for name in imported_by(path)}
    rooms = {name.split(".")[2] for name in names if name.startswith("pipeline.learn.")}
    assert rooms - {room} <= STANDS_ON[room]


def test_the_walk_finds_torch_where_it_is():
    assert "torch" in reached_from((LEARN / "network").glob("*.py"))


def test_inference_reaches_no_torch():
    names = reached_from((LEARN / "infer").glob("*.py"))
    assert "pipeline.objective.camera_lidar.image_maps" in names  # the walk goes through our own modules
    assert not {name for name in names if name.split(".")[0] == "torch"}
