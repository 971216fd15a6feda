import os
import resource
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from pipeline.fleet.executor import EXECUTORS
from tests.makers.processes import descendants, started, works
from tests.makers.ray_clusters import ray_or_skip

HERE = Path(__file__).resolve().parent
LONG_S = 1800  # whatever else the machine does


def run(name, function, kinds, folder, workers=2, watch=lambda *_: None):
    items = [(kind, str(folder)) for kind in kinds]
    return {f.item[0]: f for f in EXECUTORS[name](function, items, workers, watch)}


def tries(folder, kind):
    return len((folder / f"{kind}.tries").read_text().split())


@pytest.mark.parametrize("name", ["inline", "process"])  # of ray test_ray_tasks asks it on a cluster
def test_every_item_ends_once_and_what_fails_costs_its_own_item_only(name, behave, tmp_path):
    seen, kinds = [], ["a", "raise-1", "greedy", "b", 60 * "c"]  # more than progress has room for
    found = run(name, behave, kinds, tmp_path, workers=1, watch=lambda *at: seen.append(at))
    assert [f.value[0] for f in found.values() if f.value] == ["a done", "b done", f"{60 * 'c'} done"]
    assert found["raise-1"].error == "RuntimeError: poisoned raise-1"
    assert "jobs_for_workers" in found["raise-1"].trace
    assert "needed more than 0.25 GB of memory" in found["greedy"].error
    assert all(tries(tmp_path, kind) == 1 for kind in found)  # nobody was killed
    assert resource.getrlimit(resource.RLIMIT_DATA)[0] == resource.RLIM_INFINITY
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
    assert not [c for c in psutil.Process().children(recursive=True) if works(c, "spawn_main")]


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
    for finished in EXECUTORS[{name!r}](behave, items, 2, lambda *_: None):
        print(finished)
"""


@contextmanager
def at_work(name, tmp_path):
    """A program with two workers that sleep, and the processes below it."""
    if name == "ray":
        ray_or_skip()
    script = tmp_path / "main.py"
    script.write_text(SCRIPT.format(here=str(HERE), log=str(tmp_path), name=name))
    environment = {k: v for k, v in os.environ.items() if k != "RAY_ADDRESS"}
    with started([sys.executable, str(script)], env=environment) as process:
        deadline = time.monotonic() + LONG_S
        while not all((tmp_path / f"sleep-{i}.tmp").exists() for i in (1, 2)):
            assert time.monotonic() < deadline, "workers never began"
            assert process.poll() is None, "the program ended before its workers began"
            time.sleep(0.05)
        # Ray's agents take up to a minute to see that they are alone.
        yield process, [c for c in descendants(process) if not works(c, "Agent")]


def gone(processes):
    _, alive = psutil.wait_procs(processes, timeout=LONG_S)
    return not alive


@pytest.mark.parametrize("name", ["process", pytest.param("ray", marks=pytest.mark.slow)])
def test_sigterm_lets_workers_put_their_things_away_and_leaves_none_behind(name, tmp_path):
    with at_work(name, tmp_path) as (process, workers):
        assert len(workers) >= 2
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_S) == 143
        assert gone(workers)
    assert not list(tmp_path.glob("*.tmp"))


def test_workers_do_not_outlive_a_killed_parent(tmp_path):
    with at_work("process", tmp_path) as (process, workers):
        assert len(workers) >= 2
        process.kill()
        process.wait()
        assert gone(workers)
    assert not list(tmp_path.glob("*.tmp"))
