"""Who may import whom: schemas <- pipeline <- jobs, stages apart, the estimator blind to the simulator."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from string import Formatter

import pytest

from jobs.cli import COMMANDS
from pipeline.core.stages import STAGES
from schemas.versions import TABLES

REPO = Path(__file__).resolve().parent.parent
LAYERS = ("schemas", "pipeline", "jobs")
FOUNDATIONS = {"core", "rig", "store", "objective"}
# Folders of commands.
ROOMS = {
    "ingest", "perceive", "calibrate", "evaluate", "audit", "report", "fleet", "simulate", "learn", "verify",
    "export", "convert", "view",
}  # fmt: skip
# In core, but above the rooms: the table of contents, which knows them all, and what runs a stage of it.
JOINTS = {"stages", "runner"}


def modules():
    for layer in LAYERS:
        for path in sorted((REPO / layer).rglob("*.py")):
            yield ".".join(path.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__"), path


def imports_of(path):
    """Full names of modules that a file imports, at its top or inside functions, or by an import path in a string."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and ":" in node.value:
            target = node.value.partition(":")[0]  # import paths of backends, resolved on use
            found |= {target} if target.startswith("pipeline.") and " " not in target else set()
    return found


EDGES = [
    (name, imported)
    for name, path in modules()
    for imported in sorted(imports_of(path))
    if imported.split(".")[0] in LAYERS
]


def room(name):
    parts = name.split(".")
    if parts[0] != "pipeline" or len(parts) < 2:
        return None
    return parts[2] if parts[1] == "core" and parts[-1] in JOINTS else parts[1]


def test_schemas_know_neither_pipeline_nor_jobs_and_pipeline_knows_no_jobs():
    rank = {layer: i for i, layer in enumerate(LAYERS)}
    assert [(a, b) for a, b in EDGES if rank[a.split(".")[0]] < rank[b.split(".")[0]]] == []


def test_stage_folders_meet_only_in_the_foundations():
    met = {(room(a), room(b)) for a, b in EDGES if room(a) in ROOMS}
    # The night runs the stages, so it knows their table of contents; networks are methods of calibrate.
    allowed = {("fleet", "stages"), ("fleet", "runner"), ("calibrate", "learn")}
    assert {(a, b) for a, b in met if b not in {None, a, *FOUNDATIONS}} <= allowed


def test_foundations_stand_on_foundations_alone():
    assert [(a, b) for a, b in EDGES if room(a) in FOUNDATIONS and room(b) in ROOMS | JOINTS] == []


def test_every_folder_of_pipeline_has_a_place_in_these_rules():
    found = {room(name) for name, _ in modules()} - {None}
    assert found <= ROOMS | FOUNDATIONS | JOINTS, found


def test_nothing_that_estimates_imports_the_simulator():
    users = {a for a, b in EDGES if room(b) == "simulate" and room(a) != "simulate"}
    assert users <= {"jobs.simulate", "jobs.demo"}


def test_stages_read_only_what_an_earlier_one_writes():
    written = set()
    for stage in STAGES:
        assert {t.name for t in stage.reads} <= written, stage.name
        written |= {t.name for t in stage.writes}


def test_a_table_names_the_stage_that_writes_it():
    by_stages = {t.name: s.name for s in STAGES for t in s.writes}
    by_commands = {"outcomes": "nightly", "service_events": "service", "sign_offs": "state"}
    by_commands["poses"] = "calibrate"  # beside the calibrations that they rest on
    assert {t.name: t.made_by for t in TABLES.values()} == by_stages | by_commands


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_leads_to_a_function_with_a_sentence_of_help(command):
    module, name = COMMANDS[command][0].split(":")
    function = getattr(importlib.import_module(module), name)
    assert function.__doc__
    assert function.__annotations__["return"] in (int, "int")


def said_by(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_help_loads_few_modules_and_nothing_heavy():
    # Modules are counted because their number is what help costs, and a loaded machine does not change it.
    code = (
        "import sys; from jobs.cli import main; main(['--help']);"
        "heavy = {'torch', 'embreex', 'numpy', 'pyarrow', 'scipy', 'numba', 'cv2', 'matplotlib', 'pydantic'};"
        "print('loaded:', sorted(heavy & set(sys.modules)));"
        "print(len(sys.modules))"
    )
    *page, heavy, of_help = said_by(code)
    (of_python,) = said_by("import asyncio, json, sys; print(len(sys.modules))")
    assert heavy == "loaded: []"
    assert all(command in "\n".join(page) for command in COMMANDS if " " not in command)
    assert int(of_help) < 3 * int(of_python)  # 332 and 141; numpy alone adds 140


@pytest.mark.parametrize("room", ["audit", "calibrate", "ingest"])
def test_every_reason_of_a_room_is_given_and_with_all_its_fields(room):
    reasons = importlib.import_module(f"pipeline.{room}.reasons").REASONS
    others = [
        path for name, path in modules() if name.startswith(f"pipeline.{room}.") and path.stem != "reasons"
    ]
    nodes = [node for path in others for node in ast.walk(ast.parse(path.read_text()))]
    assert reasons.keys() <= {node.value for node in nodes if isinstance(node, ast.Constant)}
    for call in (n for n in nodes if isinstance(n, ast.Call) and ast.unparse(n.func) == "because"):
        name, given = call.args[0], {keyword.arg for keyword in call.keywords}
        named = [c.value for c in ast.walk(name) if isinstance(c, ast.Constant) and c.value in reasons]
        needed = {f for reason in named for _, f, _, _ in Formatter().parse(reasons[reason]) if f}
        assert named or not isinstance(name, ast.Constant), ast.unparse(call)
        assert None in given or needed <= given, ast.unparse(call)
