"""Study: what reading a long day in bursts costs, and whether its calibration is as good as that of all frames.

    boresight simulate --out DAY --vehicles 1 --days 1 --frames 240 --seed N        (one folder per seed)
    python tests/benchmarks/studies/long_days.py accuracy --days DAY... [--real ASTYX] --scratch FOLDER
    python tests/benchmarks/studies/long_days.py cost --days DAY --scratch FOLDER [--frames 240 2400 36000]

`accuracy` calibrates each day from all of its frames and from bursts of a part of them, against the truth (of the real
day against the logged calibration, from a prior turned by 1 deg); with `--more` as a night does, which reads on where
the frames did not suffice. `cost` makes longer logs of a simulated day: its
drives one after another, again and again, with stamps that go on; of each it takes CPU from log to verdict and bytes
that ingest reads.
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
from mcap.reader import make_reader

from pipeline.config import FleetConfig, load_fleet
from pipeline.fleet.more_frames import MOST_TIMES_MORE, asks_for_more
from pipeline.geometry.se3 import exp_so3, from_rotation_translation, inverse
from pipeline.geometry.targets import errors_at_targets
from pipeline.ingest.containers.reader import open_log
from pipeline.store.current import current_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.metrics import transform_of
from tests.makers.stages import calibrate_day, ingest_day, perceive_day

RESULTS = Path(__file__).resolve().parent.parent / "results"
ASTYX = Path(__file__).resolve().parents[2] / "end_to_end" / "astyx.toml"
SIMULATED = Partition("vehicle-1", "2026-03-02")
REAL = Partition("astyx-1", "2019-01-14")
_BETWEEN_S = 60.0  # drives of the long log: longer than what ends one
_STAMPED_AT = 4  # CDR: four bytes of encapsulation, then the header's stamp


def main() -> None:
    """Run one of the two and add its line to the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["accuracy", "cost"])
    parser.add_argument("--days", type=Path, nargs="*", default=[])
    parser.add_argument("--real", type=Path)
    parser.add_argument("--scratch", type=Path, required=True)
    parser.add_argument("--read", nargs="*", default=["all", 80, 120], help="sweeps read, of accuracy")
    parser.add_argument("--more", action="store_true", help="read on as a night does, of accuracy")
    parser.add_argument("--frames", type=int, nargs="*", default=[240, 2400, 36000])
    parser.add_argument("--out", type=Path, default=RESULTS / "long_days.jsonl")
    args = parser.parse_args()
    args.scratch.mkdir(parents=True, exist_ok=True)
    lines = accuracy(args) if args.what == "accuracy" else cost(args)
    for line in lines:
        about = {"what": args.what, "date": time.strftime("%Y-%m-%d"), "commit": commit_now()}
        print(json.dumps(line), flush=True)
        with args.out.open("a") as out:
            out.write(json.dumps(about | line) + "\n")


def accuracy(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Errors of each day from all frames and from bursts."""
    days = [(day, day / "fleet.toml", SIMULATED, day / "logs", None) for day in args.days]
    if args.real:
        days.append((args.real, ASTYX, REAL, args.real, (1.0, 0.03)))
    for folder, fleet_file, partition, logs, perturb in days:
        truth = _truth(folder, partition)
        found = (
            sorted((logs / "vehicle-1" / partition.day).iterdir()) if perturb is None else _recordings(logs)
        )
        for read in ("all" if r == "all" else int(r) for r in args.read):
            fleet = load_fleet(fleet_file).changed(ingest={"read_sweeps": read})
            lake = Lake.at(args.scratch / f"{folder.name}_{read}")
            stages = _run(found, partition, fleet, lake, perturb, more=args.more)
            records = current_records(read_records(lake, CALIBRATIONS, CalibrationRecord))
            pairs = {r.pair: _errors(r, truth[r.pair]) for r in records}
            shutil.rmtree(args.scratch / f"{folder.name}_{read}")
            yield {"day": folder.name, "read": read, **stages, "pairs": pairs}


def cost(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """CPU and bytes of logs of several lengths."""
    [day] = args.days
    sources = sorted((day / "logs" / "vehicle-1" / SIMULATED.day).iterdir())
    for frames in args.frames:
        path = args.scratch / f"long_{frames}.mcap"
        if not path.exists():
            write_long_log(sources, frames, path)
        # All of 2,400 frames take two minutes: `long_log.json` has that.
        for read in (400, "all") if frames < 1000 else (400,):
            fleet = load_fleet(day / "fleet.toml").changed(ingest={"read_sweeps": read})
            lake = args.scratch / f"lake_{frames}_{read}"
            stages = _run([path], SIMULATED, fleet, Lake.at(lake), None)
            size, log = path.stat().st_size, open_log(path)
            timeline = log.timeline()
            log.close()
            assert timeline is not None, "the writer indexes what it writes"
            shutil.rmtree(lake)
            yield {
                "frames": frames,
                "minutes": round(timeline.recorded.length_ns / 6e10, 1),
                "log_mb": size >> 20,
                "read": read,
                **stages,
                "share_read": round(stages["ingest_bytes"] / size, 4),
            }


def write_long_log(sources: Sequence[Path], frames: int, path: Path) -> None:
    """The drives one after another, again and again, until there are so many frames."""
    messages, length_ns = [], 0
    first_ns = None
    for source in sources:
        with source.open("rb") as stream:
            drive = [(s, c, m) for s, c, m in make_reader(stream).iter_messages()]
        began = min(m.log_time for _, _, m in drive)
        first_ns = began if first_ns is None else first_ns
        shift = first_ns + length_ns - began
        messages += [(s, c, m.log_time + shift, shift, bytes(m.data)) for s, c, m in drive]
        length_ns += max(m.log_time for _, _, m in drive) - began + int(_BETWEEN_S * 1e9)
    with path.open("wb") as out:
        writer = mcap.writer.Writer(out, chunk_size=1 << 20)
        writer.start()
        channels: dict[str, int] = {}
        left, repeat = frames, 0
        while left > 0:
            for schema, channel, log_time, shift, data in messages:
                if channel.topic == "/tf_static" and repeat:
                    continue
                if channel.topic not in channels:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(
                        channel.topic, channel.message_encoding, number
                    )
                left -= channel.topic.startswith("/lidar")
                if left < 0:
                    break
                by = repeat * length_ns
                at = log_time + by
                writer.add_message(channels[channel.topic], at, _stamped(channel.topic, data, shift + by), at)
            repeat += 1
        writer.finish()


def _stamped(topic: str, data: bytes, shift_ns: int) -> bytes:
    """The message with its header's stamp moved."""
    if topic == "/tf_static":
        return data
    seconds, nanoseconds = struct.unpack_from("<iI", data, _STAMPED_AT)
    moved = seconds * 10**9 + nanoseconds + shift_ns
    stamp = struct.pack("<iI", moved // 10**9, moved % 10**9)
    return data[:_STAMPED_AT] + stamp + data[_STAMPED_AT + 8 :]


def _run(
    logs: Sequence[Path],
    partition: Partition,
    fleet: FleetConfig,
    lake: Lake,
    perturb: tuple[float, float] | None,
    *,
    more: bool = False,
) -> dict[str, Any]:
    """The three stages: CPU seconds, bytes that ingest read, frames; with `more` as often as a night runs them."""
    spent: Counter[str] = Counter()
    for _ in range(1 + MOST_TIMES_MORE):
        outcomes = []
        spent["passes"] += 1
        for name, stage in (
            ("ingest", lambda f=fleet: ingest_day(logs, partition, f, lake)),
            ("perceive", lambda f=fleet: perceive_day(partition, f, lake)),
            ("calibrate", lambda f=fleet: calibrate_day(partition, f, lake, perturb=perturb, seed=0)),
        ):
            began = time.process_time()
            outcomes.append(stage())
            spent[f"{name}_cpu_s"] += time.process_time() - began
        spent["ingest_bytes"] += outcomes[0].effort.bytes_read
        if not more or not asks_for_more(outcomes):
            break
        fleet = fleet.model_copy(update={"ingest": fleet.ingest.wider})
    return {"kept": outcomes[0].kept} | {k: round(v, 1) if k.endswith("_s") else v for k, v in spent.items()}


def _errors(record: CalibrationRecord, T_true: np.ndarray) -> dict[str, Any]:
    T = transform_of(record)
    out: dict[str, Any] = {"status": record.status, "frames": record.frames_used}
    if T is None or record.covariance is None:
        return out | {"reason": record.reason}
    azimuth, elevation, _ = errors_at_targets(record.pair, T, T_true)
    sigma = np.degrees(np.sqrt(np.diag(record.covariance)[:3]))
    return out | {
        "az_deg": round(float(np.degrees(azimuth)), 3),
        "el_deg": round(float(np.degrees(elevation)), 3),
        "sigma_deg": [round(float(s), 3) for s in sigma],
    }


def _truth(folder: Path, partition: Partition) -> dict[str, np.ndarray]:
    """True transforms; of a radar, as in the other studies, the one by which its elevations come out right."""
    if partition == REAL:
        given = json.loads((folder / "given_calibration.json").read_text())["astyx-1_2019-01-14_00"]
        T_camera_lidar, T_lidar_radar = (
            np.array(given["T_camera_lidar"]),
            inverse(np.array(given["T_radar_lidar"])),
        )
        T_camera_radar = T_camera_lidar @ T_lidar_radar
        return dict(zip(PAIRS, (T_camera_lidar, T_camera_radar, T_lidar_radar), strict=True))
    truth = json.loads((folder / "truth" / partition.vehicle / f"{partition.day}.json").read_text())
    down = from_rotation_translation(
        exp_so3(np.array([0.0, truth["radar_elevation_bias_rad"], 0.0])), np.zeros(3)
    )
    return {p: np.array(truth[f"T_{p}"]) @ (down if p.endswith("radar") else np.eye(4)) for p in PAIRS}


def _recordings(folder: Path) -> list[Path]:
    return sorted(folder.glob("astyx-1_*"))


if __name__ == "__main__":
    main()
