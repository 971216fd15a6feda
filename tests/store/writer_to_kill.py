"""A server that forks a writer, kills it after the delay that it reads from stdin, and says so."""

import os
import signal
import sys
import time

import numpy as np

from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import write_partition
from schemas.calibrations import CALIBRATIONS, PAIRS
from tests.makers.lakes import write_records
from tests.makers.table_rows import make_row
from tests.makers.whole_tables import FRAMES


def make_rows():
    rng = np.random.default_rng(0)
    frames = [make_row("frames", rng, free=4000, image=rng.bytes(100_000)) for _ in range(12)]
    return frames, [
        make_row("calibrations", rng, vehicle="car", day="2026-03-02", pair=pair) for pair in PAIRS
    ]


def write_generation(lake, generation, rows, records):
    partition = Partition("car", "2026-03-02")
    with write_partition(lake, FRAMES, partition, f"key-{generation}", "0") as writer:
        for first in range(0, 12, 3):
            for row in rows:
                object.__setattr__(row, "drive", generation)
            writer.append(rows[first : first + 3])
    write_records(lake, CALIBRATIONS, records, f"key-{generation}")


def write_for_ever(lake, generation, rows, records):
    while True:
        generation += 1
        write_generation(lake, generation, rows, records)


def main():
    lake = Lake.at(sys.argv[1])
    rows, records = make_rows()
    write_generation(lake, 0, rows, records)  # on a busy machine the first kill may come before a whole write
    print("ready", flush=True)
    for turn, line in enumerate(sys.stdin):
        child = os.fork()
        if child == 0:
            write_for_ever(lake, 100_000 * (turn + 1), rows, records)
        time.sleep(float(line))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        print("killed", flush=True)


main()
