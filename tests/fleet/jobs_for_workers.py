"""Functions that spawned workers import by path: they sleep, fail, die or write as their item says."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from pipeline.core.memory import at_most


def behave(item, progress):
    kind, where = item
    log = Path(where)
    with (log / f"{kind}.tries").open("a") as file:
        file.write(f"{os.getpid()}\n")
    progress(1, 2, f"{kind} at work")
    first = len((log / f"{kind}.tries").read_text().split()) == 1
    if kind == "die-always" or (kind == "die-once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    elif kind.startswith("raise"):
        raise RuntimeError(f"poisoned {kind}")
    elif kind == "greedy":
        with at_most(0.25):
            keep = [np.ones(1 << 22) for _ in range(64)]  # 32 MiB each
        return len(keep)
    elif kind.startswith("wait"):
        time.sleep(2)
    elif kind.startswith("sleep"):
        try:
            (log / f"{kind}.tmp").touch()
            for _ in range(600):
                time.sleep(0.1)  # Ray's order to stop waits for the interpreter's turn
        finally:
            (log / f"{kind}.tmp").unlink()
    return f"{kind} done", os.environ.get("NUMBA_NUM_THREADS")
