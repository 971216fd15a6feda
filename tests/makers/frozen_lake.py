"""Makes tests/store/lake_1_0, which every later release must read, by the commands of this release.

    .venv/bin/python -m tests.makers.frozen_lake tests/store/lake_1_0

Three days of 20 frames for the record tables, whose moments `gc` deletes, and a day of one frame for the others.
"""

import hashlib
import json
import shutil
import sys
import tempfile
from pathlib import Path

from jobs.cli import main
from pipeline.store.moments import joined
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.tables import read_rows
from schemas.moments import MOMENTS, PERCEIVED
from schemas.training import TRAINING
from schemas.versions import TABLES

DIGESTS = "digests.json"
_WHOLE = Partition("vehicle-2", "2026-03-05")
_FLEETS = {  # rig, days, frames, first day; of all rigs the second has the smallest sweeps
    "vehicle-1": ("demo", "3", "20", "2026-03-02"),
    _WHOLE.vehicle: ("keyhole", "1", "1", _WHOLE.day),
}


def digests(lake):
    """Of each table, a digest of every column, as this release reads it."""
    rows = {name: read_records(lake, t, t.row_type) for name, t in TABLES.items() if t.is_record_table}
    rows["training"] = read_rows(lake, TRAINING, _WHOLE, TRAINING.row_type)
    name_of = {table.row_type: name for name, table in TABLES.items()}
    for schema in (MOMENTS, PERCEIVED):
        for moment, of_sensors in joined(lake, schema, _WHOLE):
            for row in (moment, *of_sensors.values()):
                rows.setdefault(name_of[type(row)], []).append(row)
    return {
        name: {c.name: _digest([getattr(row, c.name) for row in found]) for c in TABLES[name].columns}
        for name, found in rows.items()
    }


def _digest(values):
    plain = [(v.dtype.str, v.shape, v.tobytes()) if hasattr(v, "tobytes") else v for v in values]
    return hashlib.sha256(repr(plain).encode()).hexdigest()[:12] if values else "no rows"


def run(*arguments):
    """A command; 3, something was held, is as good as done."""
    if (code := main(arguments)) not in (0, 3):
        raise SystemExit(code)


def make(out):
    """Write lake, fleet.toml and digests into the folder `out`."""
    with tempfile.TemporaryDirectory() as work:
        for vehicle, (rig, days, frames, first) in _FLEETS.items():
            own = Path(work) / vehicle
            shape = ["--rig", rig, "--vehicles", "1", "--days", days, "--frames", frames]
            run("simulate", "--out", str(own), *shape, "--first-day", first)
            (own / "logs" / "vehicle-1").rename(own / "logs" / vehicle)
            fleet = own / "fleet.toml"
            fleet.write_text(fleet.read_text().replace('"vehicle-1"', f'"{vehicle}"'))
            place = ["--fleet", str(fleet), "--lake", str(out)]
            logs = f"{own}/logs/{{vehicle}}/{{day}}/*"
            run("nightly", *place, "--logs", logs, "--no-pictures", "--executor", "inline")
            if vehicle == _WHOLE.vehicle:
                run("prepare", *place, "--executor", "inline")
            else:
                shutil.copy(fleet, out / fleet.name)
                run("gc", "--lake", str(out), "--images-days", "1", "--observations-days", "1")
    about = ["--lake", str(out), "--vehicle", "vehicle-1"]
    run("state", *about, "--sign-off", "anna")
    run("service", *about, "--day", "2026-03-03", "--kind", "repair", "--sensor", "radar")
    shutil.rmtree(out / "report")
    (out / DIGESTS).write_text(json.dumps(digests(Lake.at(out)), indent=1) + "\n")


if __name__ == "__main__":
    make(Path(sys.argv[1]))
