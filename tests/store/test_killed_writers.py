"""Writers that are killed at any moment leave a day of one work or none, and every record that they committed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.store.moments import is_whole
from pipeline.store.partitions import Partition
from pipeline.store.views import frames_of, ingested
from schemas.calibrations import PAIRS
from tests.makers.table_rows import read_calibrations

DAY = Partition("car", "2026-03-02")
# Writes the day and three records of one work, again and again; names each work when it is in the lake.
_WRITER = """
import sys, numpy as np
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS, PAIRS
from tests.makers.lakes import write_frames
from tests.makers.table_rows import make_frame, make_record
lake, rng, turn = Lake.at(sys.argv[1]), np.random.default_rng(0), sys.argv[2]
for i in range(10_000):
    work = f"{turn}-{i}"
    frames = [make_frame(rng, frame_index=k, stamp_ns=k * 10**8, log=work) for k in range(6)]
    write_frames(lake, Partition("car", "2026-03-02"), frames, key=work)
    commit_records(lake, CALIBRATIONS, [make_record(rng, work, pair=pair) for pair in PAIRS])
    print(work, flush=True)
"""


@pytest.mark.slow
def test_a_writer_killed_at_any_moment_loses_nothing_that_it_committed_and_leaves_no_half(lake, rng):
    told, kept, command = [], set(), [sys.executable, "-c", _WRITER, str(lake.root)]
    repo = Path(__file__).resolve().parents[2]
    for turn in range(8):
        with subprocess.Popen([*command, str(turn)], cwd=repo, stdout=subprocess.PIPE, text=True) as writer:
            told.append(writer.stdout.readline().strip())
            time.sleep(rng.uniform(0, 0.3))
            writer.send_signal(signal.SIGKILL)
            told += writer.stdout.read().split()
        manifest = ingested(lake, DAY)
        if manifest is not None:
            kept.add(manifest.work_key)
            assert is_whole(lake, DAY, manifest)
            assert {f.log for f in frames_of(lake, DAY)} == {manifest.work_key}
        found = read_calibrations(lake)
        pairs = {k: sorted(r.pair for r in found if r.work_key == k) for k in {r.work_key for r in found}}
        assert all(p == sorted(PAIRS) for p in pairs.values())
        assert set(told) <= set(pairs)
    assert kept
    assert lake.damage == []
