"""A night of 10,000 vehicles on paper: what was measured of a vehicle-day, and what follows from it.

    python -m tests.benchmarks.paper_night --logs FOLDER

CPU, log bytes and memory of a day of the paper's sensors come from other results (long_log.json, day_cost.json,
night_overhead.jsonl). Requests, and how large a day is in the lake beside its log, are measured here: two small
simulated vehicle-days (demo rig, seed 5, in FOLDER) go through a night into a server that speaks S3 on this machine,
which counts.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from tests.benchmarks.studies.commits import commit_now
from tests.makers.s3_server import BUCKET, running

RESULTS = Path("tests/benchmarks/results")
VEHICLES = 10_000
SWEEPS = 400  # [ingest] read_sweeps: what of a long day is read
PAGE_S = 0.9  # of a vehicle-day that changed, CPU; studies/lake_age.py
LOOKED_BACK = 6  # days before the last one, that are up to date
# Dollars, assumed: an hour of a virtual CPU with 2 GiB (spot), a stored GB for a month, a thousand PUTs, of GETs.
CPU_HOUR, GB_MONTH, PUTS_1000, GETS_1000 = 0.02, 0.023, 0.005, 0.0004
IMAGES_DAYS = 30  # heavy tables leave the lake after so long (`boresight gc --images-days`)


def read(name):
    """A result, or the last line of it."""
    text = (RESULTS / name).read_text()
    return json.loads(text.splitlines()[-1] if name.endswith("l") else text)


def small_night(logs):
    """Requests and bytes of a night of two small vehicle-days, by one worker, into S3."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    boresight = [sys.executable, "-m", "jobs.cli"]
    made = ["simulate", "--out", str(logs), "--vehicles", "2", "--days", "1", "--frames", "40", "--seed", "5"]
    if not (logs / "truth").exists():
        subprocess.run([*boresight, *made], check=True, env=environment, stdout=subprocess.DEVNULL)
    night = [
        "nightly", "--fleet", f"{logs}/fleet.toml", "--lake", f"s3://{BUCKET}/lake", "--workers", "2",
        "--logs", f"{logs}/logs/{{vehicle}}/{{day}}/*",
    ]  # fmt: skip
    with running() as s3:
        done = subprocess.run(
            [*boresight, *night], check=False, env=environment | s3.environment, capture_output=True
        )
        assert done.returncode in (0, 3), done.stderr[-2000:]
        counts = s3.faults()
        names = (
            "moments",
            "images",
            "sweeps",
            "scans",
            "perceived",
            "image_features",
            "sweep_features",
            "scan_features",
        )
        tables = sum(s3.stored(f"lake/{name}/") for name in names)
        pages = s3.stored("lake/report/fleet_days/")
    log_bytes = sum(p.stat().st_size for p in (logs / "logs").rglob("*") if p.is_file())
    days = json.loads(done.stdout.splitlines()[-1])["vehicle_days"]
    return {
        "vehicle_days": days,
        "puts": counts["puts"],
        "gets": counts["gets"],
        "tables_per_log": round(tables / log_bytes, 3),
        "page_mb": round(pages / days / 1e6, 2),
    }


def vehicle_day(small):
    """What a day of the paper's sensors costs, of which SWEEPS are read."""
    long, cost, overhead = read("long_log.json"), read("day_cost.json"), read("night_overhead.jsonl")
    per_frame = {stage: long[stage]["cpu_s"] / long["frames"] for stage in ("ingest", "perceive")}
    calibrate = [day["cpu_s"] for day in cost["days"].values()]
    read_mb = long["log_mb"] / long["frames"] * SWEEPS
    cpu_s = {stage: round(SWEEPS * s, 1) for stage, s in per_frame.items()}
    cpu_s |= {
        "calibrate": round(sum(calibrate) / len(calibrate), 1),
        "page": PAGE_S,
        "days before": round(LOOKED_BACK * overhead["vehicle-1"]["cpu_ms"] / 1e3, 2),
    }
    return {
        "cpu_s": cpu_s,
        "peak_mb": max(long[stage]["peak_mb"] for stage in per_frame),
        "log_mb_read": round(read_mb),
        "lake_mb_written": round(read_mb * small["tables_per_log"] + small["page_mb"]),
        "puts": round(small["puts"] / small["vehicle_days"]),
        "gets": round(small["gets"] / small["vehicle_days"]),
    }


def on_paper(day):
    """What 10,000 vehicles take that drive every day."""
    cpu_s = sum(day["cpu_s"].values())
    dollars = {
        "cpu": 365 * cpu_s / 3600 * CPU_HOUR,
        "requests": 365 * (day["puts"] * PUTS_1000 + day["gets"] * GETS_1000) / 1000,
        "stored": 12 * day["lake_mb_written"] / 1e3 * IMAGES_DAYS * GB_MONTH,
    }
    return {
        "cpu_hours": round(VEHICLES * cpu_s / 3600),
        "hours_on_64_cpus": round(VEHICLES * cpu_s / 3600 / 64, 1),
        "log_tb_read": round(VEHICLES * day["log_mb_read"] / 1e6, 2),
        "lake_tb_written": round(VEHICLES * day["lake_mb_written"] / 1e6, 2),
        "million_requests": round(VEHICLES * (day["puts"] + day["gets"]) / 1e6, 2),
        "dollars_per_vehicle_year": {k: round(v, 2) for k, v in dollars.items()}
        | {"all": round(sum(dollars.values()), 2)},
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=Path, required=True)
    small = small_night(parser.parse_args().logs)
    day = vehicle_day(small)
    assumed = {"cpu_hour": CPU_HOUR, "gb_month": GB_MONTH, "puts_1000": PUTS_1000, "gets_1000": GETS_1000,
               "images_days": IMAGES_DAYS, "sweeps": SWEEPS}  # fmt: skip
    told = {
        "commit": commit_now(),
        "small_night": small,
        "vehicle_day": day,
        "night_of_10000": on_paper(day),
        "assumed": assumed,
    }
    (RESULTS / "paper_night.json").write_text(json.dumps(told, indent=1) + "\n")
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
