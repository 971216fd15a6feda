"""A lake as a fleet leaves it that is calibrated and audited every night: by algebra, for as many nights as asked.

Nothing is calibrated. Vehicles have mountings and sigmas of their own, days scatter as they say, some are held or
refused; vehicles join all the time, and one of a hundred has a radar that was knocked. A night is a commit to each
table, with the upkeep that follows it, so that files, generations and logs are those of a lake of that age.
"""

import datetime as dt
import tempfile
from dataclasses import dataclass, fields, replace

import numpy as np
import pyarrow as pa
from deltalake import WriterProperties, write_deltalake

from pipeline.core.config import FleetConfig
from pipeline.core.results import Outcome
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.fleet.ledger import outcome_row
from pipeline.rig.se3 import adjoint, exp_se3, to_quaternion
from pipeline.store.commits import commit_records
from pipeline.store.delta import merge_rows, open_table, stored_schema, tidy_table
from pipeline.store.partitions import Lake
from pipeline.store.rows import to_table
from schemas.calibrations import CALIBRATIONS, PAIRS
from schemas.drift import DRIFT
from schemas.outcomes import OUTCOMES
from schemas.states import STATES
from tests.audit.fleet_records import T_CAMERA_LIDAR, T_LIDAR_RADAR, covariance_of, vehicle_records
from tests.makers.fleet_files import THREE_SENSORS

__all__ = ["FleetHistory", "one_rig_fleet"]

TABLES = (CALIBRATIONS, OUTCOMES, DRIFT, STATES)
WINDOW_DAYS = 28  # as audit.window_days
DIAGNOSTICS = 40  # numbers behind a verdict: records of a simulated day have 27 to 51
HELD, REFUSED = 0.05, 0.03  # shares of vehicle-days
NEW_DAYS = 20  # before the end, over which two of a hundred vehicles join
KNOCKED_DAYS = 9  # before the end, from which one of a hundred has a radar that points 1 deg elsewhere


def one_rig_fleet():
    """A fleet.toml of one rig; its vehicles are those that have records."""
    return FleetConfig.model_validate({"fleet": {"name": "study"}, "rigs": {"default": THREE_SENSORS}})


@dataclass(frozen=True)
class FleetHistory:
    """So many vehicles over so many days, the first of which is `begin`."""

    vehicles: int
    days: int
    begin: dt.date = dt.date(2025, 1, 1)

    def __post_init__(self):
        """What is the same every night: mountings, sigmas, first days, and rows to take over."""
        rng, V = np.random.default_rng(self.vehicles), self.vehicles
        v = np.arange(V)
        own = {
            "names": np.array([f"vehicle-{k:05d}" for k in v]),
            "mounted": exp_se3(rng.normal(size=(2, V, 6)) * np.radians(1.0)),
            "factor": np.exp(0.1 * rng.normal(size=V)),
            "first": np.where(
                v % 50 == 3, self.days - NEW_DAYS + v // 50 % NEW_DAYS,
                np.where(v % 25 == 4, (self.days * (v // 25 % 20)) // 20, 0),
            ).clip(0),
            "knocked": v % 100 == 7,
            "template": _templates(),
        }  # fmt: skip
        self.__dict__.update(own)

    def day_name(self, index):
        """The index-th day."""
        return (self.begin + dt.timedelta(days=int(index))).isoformat()

    def commit_night(self, lake, index, *, merge=False):
        """Commit a night to each table and do its upkeep; `merge`: as a night does, else as fast as it goes."""
        for schema in TABLES:
            self.commit(lake, schema, index, merge=merge)
            for _ in tidy_table(lake, schema):
                pass

    def commit(self, lake, schema, index, *, merge=False):
        """Commit a night's rows to one table."""
        rows, table = self.rows(schema, index), open_table(lake, schema)
        if table is None or merge:
            merge_rows(lake, schema, rows)
        else:
            write_deltalake(
                table, rows, mode="append", writer_properties=WriterProperties(compression="ZSTD")
            )

    def rows(self, schema, index):
        """A night's rows: one vehicle's for each that has joined; calibrations have numbers of their own."""
        here = np.flatnonzero(self.first <= index)
        one, day = self.template[schema.name], self.day_name(index)
        each = one.num_rows
        table = one.take(pa.array(np.tile(np.arange(each), len(here))))
        names = np.repeat(self.names[here], each)
        keys = np.char.add(np.char.add(names, "-"), day)
        stamp = f"{day}T23:00:00.000000Z"
        columns = {"vehicle": names, "work_key": keys}
        columns |= {n: np.full(len(names), t) for n, t in
                    (("day", day), ("recorded_at", stamp), ("asserted_at", stamp), ("month", day[:7]))}  # fmt: skip
        if schema is CALIBRATIONS:
            columns |= self._measured(here, index)
        for name, values in columns.items():
            field = table.schema.field(name)
            found = values if isinstance(values, pa.Array) else pa.array(values, field.type)
            table = table.set_column(table.schema.get_field_index(name), field, found)
        return table

    def _measured(self, here, index):
        """Poses, covariances, statuses and diagnostics of a day, in order of vehicle and pair."""
        rng = np.random.default_rng([self.vehicles, index])
        n, factor = len(here), self.factor[here]
        T, C = {}, {}
        knock = np.where(self.knocked[here] & (index >= self.days - KNOCKED_DAYS), np.radians(1.0), 0.0)
        for k, (pair, clean) in enumerate((("camera_lidar", T_CAMERA_LIDAR), ("lidar_radar", T_LIDAR_RADAR))):
            C[pair] = covariance_of(pair) * (factor**2)[:, None, None]
            noise = rng.multivariate_normal(np.zeros(6), covariance_of(pair), n) * factor[:, None]
            T[pair] = exp_se3(noise) @ self.mounted[k, here] @ clean
        turn = np.zeros((n, 6))
        turn[:, 2] = knock
        T["lidar_radar"] = T["lidar_radar"] @ exp_se3(turn)
        T["camera_radar"] = T["camera_lidar"] @ T["lidar_radar"]
        A = np.stack([adjoint(t) for t in T["camera_lidar"]])
        C["camera_radar"] = C["camera_lidar"] + A @ C["lidar_radar"] @ A.swapaxes(1, 2)
        poses = np.stack([T[p] for p in PAIRS], axis=1).reshape(-1, 4, 4)
        covariance = np.stack([C[p] for p in PAIRS], axis=1).reshape(-1, 36)
        drawn = np.repeat(rng.random(n), len(PAIRS))
        refused, held = drawn < REFUSED, drawn < REFUSED + HELD
        status = np.where(refused, "refused", np.where(held, "held", "accepted"))
        q = to_quaternion(poses)
        numbers = {name: q[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))}
        numbers |= {name: poses[:, i, 3] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))}
        columns = {name: pa.array(values, pa.float64(), mask=refused) for name, values in numbers.items()}
        columns["covariance"] = _blobs(covariance, refused)
        columns["common_covariance"] = _blobs(0.3 * covariance, refused)
        columns["diagnostics"] = _numbers(rng.normal(size=(len(poses), DIAGNOSTICS)) * 1e-4)
        return columns | {"status": pa.array(status)}


def _blobs(values, absent):
    data = np.ascontiguousarray(values, "<f8")
    offsets = np.arange(len(data) + 1, dtype=np.int32) * (8 * data.shape[1])
    valid = pa.py_buffer(np.packbits(~absent, bitorder="little").tobytes())
    return pa.Array.from_buffers(
        pa.binary(), len(data), [valid, pa.py_buffer(offsets.tobytes()), pa.py_buffer(data.tobytes())]
    )


def _numbers(values):
    rows, count = values.shape
    names = ["holdout_azimuth_shift_rad", "holdout_elevation_shift_rad"]
    names += [f"some_number_behind_the_verdict_{k:02d}_m" for k in range(count - len(names))]
    offsets = pa.array(np.arange(rows + 1, dtype=np.int32) * count)
    keys = pa.array(names).take(pa.array(np.tile(np.arange(count), rows)))
    return pa.MapArray.from_arrays(offsets, keys, pa.array(values.ravel()))


def _without_reference(state):
    """A state that keeps none: mountings differ, and a night that looks makes them."""
    kept = {f.name: f.default for f in fields(state) if f.name.startswith("reference_")}
    return replace(state, **kept)


def _templates():
    """Rows of one vehicle and night of every table, as files have them."""
    records = vehicle_records("v", WINDOW_DAYS, np.random.default_rng(0))
    with tempfile.TemporaryDirectory() as folder:
        lake = Lake.at(folder)
        commit_records(lake, CALIBRATIONS, records)
        task = Task(one_rig_fleet(), lake, Window())
        states = [_without_reference(r) for r in STATE.run(task).records]
        audited = {DRIFT: list(AUDIT.run(task).records), STATES: states}
    outcomes = [
        outcome_row(Outcome(stage, "v", "", "done", "key"), "joint")
        for stage in ("ingest", "perceive", "calibrate")
    ]
    rows = {CALIBRATIONS: records[: len(PAIRS)], OUTCOMES: outcomes, **audited}
    tables = {}
    for schema, own in rows.items():
        stamped = [replace(r, day="2025-01-01", recorded_at="-", asserted_at="-") for r in own]
        table = to_table(stamped, schema).append_column("month", pa.array(["2025-01"] * len(own)))
        tables[schema.name] = table.cast(stored_schema(schema))
    return tables
