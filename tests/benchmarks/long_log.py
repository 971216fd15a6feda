"""Study: peak resident memory of ingest and perceive on a 20-minute synthetic vehicle-day, one worker.

    python tests/benchmarks/long_log.py --folder FOLDER --minutes 20 --out long_log.json

The simulated logs stay in FOLDER (they take minutes to make) and are used again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from tests.benchmarks.studies.commits import commit_now

RATE_HZ = 2.0
GOAL_MB = 1500
_STAGE = """
import sys, time
from pathlib import Path
from pipeline.config import load_fleet
from pipeline.store.partitions import Lake, Partition
stage, folder, lake = sys.argv[1], Path(sys.argv[2]), Lake.at(sys.argv[3])
fleet = load_fleet(folder / "fleet.toml").changed(ingest={"read_sweeps": "all"})  # the most that a worker may be asked
day = Partition("vehicle-1", "2026-03-02")
if stage == "ingest":
    from tests.makers.stages import ingest_day
    result = ingest_day(sorted((folder / "logs").rglob("*.mcap")), day, fleet, lake)
else:
    from tests.makers.stages import perceive_day
    result = perceive_day(day, fleet, lake)
# Not ru_maxrss: a child inherits its parent's.
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(result.rows, int(peak.split()[1]) // 1024, round(time.process_time(), 1))
"""


def main() -> None:
    """Simulate where there is nothing yet, run both stages in processes of their own, write what they took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    frames = round(args.minutes * 60 * RATE_HZ)
    if not (args.folder / "fleet.toml").exists():
        command = ["simulate", "--out", str(args.folder), "--vehicles", "1", "--days", "1"]
        command += ["--frames", str(frames), "--rate-hz", str(RATE_HZ)]
        subprocess.run([sys.executable, "-m", "jobs.cli", *command], check=True)
    result = {
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit_now(),
        "minutes": args.minutes,
        "frames": frames,
        "goal_mb": GOAL_MB,
    }
    result["log_mb"] = sum(p.stat().st_size for p in (args.folder / "logs").rglob("*.mcap")) // 2**20
    for stage in ("ingest", "perceive"):
        command = [sys.executable, "-c", _STAGE, stage, str(args.folder), str(args.folder / "lake")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows, peak_mb, cpu_s = done.stdout.split()
        result[stage] = {"rows": int(rows), "peak_mb": int(peak_mb), "cpu_s": float(cpu_s)}
    args.out.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
