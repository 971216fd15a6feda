"""The study of executors: efficiency is by the clock, and what a night waited for the machine's other work is told."""

import os
import subprocess
import sys

from tests.benchmarks.studies.executor_efficiency import _spent_s, table


def night(executor, wall_s, waited_s=0.0, vehicle_days=4):
    return {
        "executor": executor,
        "wall_s": wall_s,
        "waited_s": waited_s,
        "alone_s": wall_s - waited_s,
        "vehicle_days": vehicle_days,
    }


def test_efficiency_is_of_the_shortest_nights_by_the_clock_with_all_that_they_waited():
    lines = [night("inline", 100.0), night("inline", 90.0), night("process", 60.0, 10.0), night("ray", 55.0)]
    assert table([*lines, night("process", 99.0, vehicle_days=8)]) == (
        "4 vehicle-days: inline 90.0 s, 0.0 of them waited (2 nights), process 60.0 s, 10.0 of them waited (1 nights), "
        "ray 55.0 s, 0.0 of them waited (1 nights), efficiency of process 0.75 by the clock (0.90), "
        "efficiency of ray 0.82 by the clock (0.82), ray against process 1.09\n"
        "8 vehicle-days: process 99.0 s, 0.0 of them waited (1 nights)\n"
    )


def test_what_a_process_computes_and_what_it_waits_for_a_cpu_are_told_apart():
    burn = "import os, time; os.sched_setaffinity(0, {%d})\nwhile time.process_time() < 0.3: pass\nprint(1); input()"
    cpu = min(os.sched_getaffinity(0))
    burning = [
        subprocess.Popen(
            [sys.executable, "-c", burn % cpu],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        for _ in range(2)
    ]
    for process in burning:
        process.stdout.readline()
    spent = [_spent_s(process.pid)[process.pid] for process in burning]
    for process in burning:
        process.communicate(b"\n")
    assert all(0.25 < computed < 1.0 for computed, _ in spent)
    # Both on one CPU: together they waited about as long as one of them computed.
    assert sum(waited for _, waited in spent) > 0.15
