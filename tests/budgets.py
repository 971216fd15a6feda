"""Budgets: lines of each room (asked by `make lint`), and CPU seconds of each folder's quick tests (asked by conftest).

    python -m tests.budgets

The numbers stand in budgets.toml, and only fall. Raising one is a line in the commit that says why.
"""

import sys
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parent.parent
BUDGETS = tomllib.loads((Path(__file__).parent / "budgets.toml").read_text())


def lines_of_rooms() -> dict[str, int]:
    """Lines of Python by room: the folders of pipeline/, and jobs, schemas and tests as a whole."""
    rooms = sorted(p for p in (REPO / "pipeline").iterdir() if p.is_dir() and any(p.rglob("*.py")))
    folders = {f"pipeline/{p.name}": p for p in rooms} | {n: REPO / n for n in ("jobs", "schemas", "tests")}
    return {
        name: sum(len(p.read_text().splitlines()) for p in folder.rglob("*.py"))
        for name, folder in folders.items()
    }


def beyond(found: Mapping[str, float], budget: Mapping[str, float]) -> list[str]:
    """A sentence for each that is larger than its budget, or has none."""
    return [
        f"{name}: {value:.0f}, and tests/budgets.toml allows {budget.get(name, 0):.0f}"
        for name, value in sorted(found.items())
        if value > budget.get(name, 0)
    ]


def slowness() -> float:
    """CPU time of a fixed piece of work, in units of the machine on which the budgets were measured."""
    costs_s = []
    for _ in range(5):
        began_s = time.process_time()
        matrix = np.eye(40) * 0.5
        for i in range(1500):
            matrix = matrix @ matrix + i / 1500
            matrix /= np.abs(matrix).max()
        sorted(str(i) for i in range(40_000))
        costs_s.append(time.process_time() - began_s)
    return float(np.median(costs_s)) / float(BUDGETS["machine"]["fixed_work_s"])


def main() -> int:
    """Exit code 1 where a room exceeds its lines."""
    found = lines_of_rooms()
    too_many = beyond(found, BUDGETS["lines"])
    gone = sorted(set(BUDGETS["lines"]) - set(found))
    for sentence in [*too_many, *(f"{name} is gone: take its budget out" for name in gone)]:
        print(f"lines of {sentence}")
    return 1 if too_many or gone else 0


if __name__ == "__main__":
    sys.exit(main())
