import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from pipeline.fleet.executor import EXECUTORS

HERE = Path(__file__).resolve().parent


@pytest.fixture
def behave(monkeypatch):
    # Spawned workers find the function by its module's name: they take sys.path from this process.
    monkeypatch.syspath_prepend(str(HERE))
    spec = importlib.util.spec_from_file_location("jobs_for_workers", HERE / "jobs_for_workers.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "jobs_for_workers", module)
    spec.loader.exec_module(module)
    return module.behave


def run(name, function, kinds, folder, workers=2, watch=lambda *_: None):
    items = [(kind, str(folder)) for kind in kinds]
    return {f.item[0]: f for f in EXECUTORS[name](function, items, workers, watch)}


def tries(folder, kind):
    return len((folder / f"{kind}.tries").read_text().split())


@pytest.mark.parametrize("name", EXECUTORS)
def test_every_item_ends_once_and_an_error_stays_with_its_own_item(name, behave, tmp_path):
    seen = []
    found = run(name, behave, ["a", "raise-1", "b", "c"], tmp_path, watch=lambda *at: seen.append(at))
    assert {k: f.value[0] for k, f in found.items() if f.value} == {
        "a": "a done",
        "b": "b done",
        "c": "c done",
    }
    assert found["raise-1"].error == "RuntimeError: poisoned raise-1"
    assert "jobs_for_workers" in found["raise-1"].trace
    assert all(tries(tmp_path, kind) == 1 for kind in found)
    if name == "inline":
        assert (0, 1, 2, "a at work") in seen


def test_workers_have_one_thread_and_the_parent_keeps_its_setting(behave, tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    found = run("process", behave, ["a"], tmp_path)
    assert found["a"].value[1] == "1"
    assert os.environ["NUMBA_NUM_THREADS"] == "2"


def test_a_killed_worker_costs_its_own_item_only_and_is_retried_within_bounds(behave, tmp_path):
    found = run("process", behave, ["a", "die-always", "b", "die-once", "c", "raise-1", "d"], tmp_path)
    assert {k for k, f in found.items() if f.error} == {"die-always", "raise-1"}
    assert found["die-once"].value[0] == "die-once done"
    assert "killed" in found["die-always"].error
    # Twice alone; before that once in company, unless a neighbour's death came before it had begun.
    assert 2 <= tries(tmp_path, "die-always") <= 3
    assert tries(tmp_path, "die-once") <= 3
    children = psutil.Process().children(recursive=True)
    assert not [c for c in children if "spawn_main" in " ".join(c.cmdline())]


SCRIPT = """
import sys
sys.path.insert(0, {here!r})
from jobs_for_workers import behave
from pipeline.fleet.executor import EXECUTORS
import signal

def stop(signum, frame):
    sys.exit(128 + signum)

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, stop)
    items = [("sleep-1", {log!r}), ("sleep-2", {log!r})]
    for finished in EXECUTORS["process"](behave, items, 2, lambda *_: None):
        print(finished)
"""


def started(tmp_path):
    script = tmp_path / "main.py"
    script.write_text(SCRIPT.format(here=str(HERE), log=str(tmp_path)))
    process = subprocess.Popen([sys.executable, str(script)])
    deadline = time.monotonic() + 30
    while not all((tmp_path / f"sleep-{i}.tmp").exists() for i in (1, 2)):
        assert time.monotonic() < deadline, "workers never began"
        time.sleep(0.05)
    return process, psutil.Process(process.pid).children(recursive=True)


def gone(processes, seconds):
    _, alive = psutil.wait_procs(processes, timeout=seconds)
    return not alive


def test_sigterm_lets_workers_put_their_things_away_and_leaves_none_behind(tmp_path):
    process, workers = started(tmp_path)
    process.send_signal(signal.SIGTERM)
    assert process.wait(20) == 143
    assert gone(workers, 5)
    assert not list(tmp_path.glob("*.tmp"))


def test_workers_do_not_outlive_a_killed_parent(tmp_path):
    process, workers = started(tmp_path)
    process.kill()
    process.wait()
    assert gone(workers, 10)
    assert not list(tmp_path.glob("*.tmp"))
