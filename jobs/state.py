"""`boresight state`: the calibration that each vehicle should load tonight."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from textwrap import wrap
from types import MappingProxyType
from typing import Any

import numpy as np

from jobs.terminal.record_tables import numbers
from jobs.terminal.summary import left_out, print_json
from jobs.terminal.vehicle_status import require_vehicle
from pipeline.core.errors import ConfigError
from pipeline.export.lake import signed_state
from pipeline.rig.se3 import change_between, to_quaternion
from pipeline.store.corrections import read_sign_offs, sign
from pipeline.store.current import current_states, state_values
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.sign_offs import SignOff
from schemas.states import STATES, StateRow

__all__ = ["state"]

_WIDTH, _INDENT = 80, 4


def state(
    *,
    lake: str,
    vehicle: str | None = None,
    method: str = "joint",
    previous: bool = False,
    sign_off: str | None = None,
    note: str = "",
    json: bool = False,
) -> int:
    """Show what each vehicle should load tonight: a pose per sensor relative to the reference, with sigma.

    The days since a sensor last moved determine its pose; without such days it is at the prior. The sigma is that of
    tomorrow's drive.

    `boresight nightly` and `boresight audit` write the table states; this command prints its latest rows. A person
    may sign one off (table sign_offs: who, when, which); `boresight export --signed-off` writes the last such state.
    To go back: --previous --sign-off NAME. Against a file or log of the car: `boresight compare VEHICLE@state FILE`.

    Args:
        lake: folder of the tables.
        vehicle: only this vehicle.
        method: calibration method.
        previous: of one vehicle: the state that was signed off before the last one.
        sign_off: of one vehicle: your name; records that the state shown is approved for loading.
        note: free text beside the sign-off.
        json: print only a JSON list: keys as the columns of table states, "T" and "T_prior" (4x4 row-major
            T_parent_child, null if unknown), and "in_words". Rows of sensors (`sensor` is not null) and rows of the
            edges, composed of the sensors' poses.
    """
    tables = Lake.existing(lake)
    found = [r for r in read_records(tables, STATES, StateRow, vehicle=vehicle) if r.method == method]
    if vehicle is not None and not found:
        require_vehicle(tables, vehicle)
    if vehicle is None and (previous or sign_off is not None):
        raise ConfigError("command line", "vehicle", "sign off one vehicle at a time: give --vehicle")
    shown = current_states(found)
    if previous and vehicle is not None:
        shown = signed_state(tables, vehicle, method, before=True)
    if sign_off is not None:
        sign(tables, shown, sign_off, note)
    signed = {s.vehicle: s for s in read_sign_offs(tables, method)}
    rows = [row | {"signed_by": _signer(row, signed)} for row in state_values(shown)]
    if json:
        print_json(rows, indent=2)
    elif rows:
        sys.stdout.write(state_text(rows, signed))
    else:
        sys.stdout.write(f"no state in {lake}: run `boresight nightly`\n")
    return 3 if left_out(tables) else 0


def _signer(row: dict[str, Any], signed: Mapping[str, SignOff]) -> str | None:
    last = signed.get(row["vehicle"])
    return last.signed_by if last is not None and last.state_key == row["work_key"] else None


def state_text(rows: Sequence[dict[str, Any]], signed: Mapping[str, SignOff] = MappingProxyType({})) -> str:
    """The states of vehicles, of `state_values`; edges of a vehicle with poses are left out.

    `signed`: the last sign-off by vehicle.
    """
    by_sensor = {(row["vehicle"], row["method"]) for row in rows if row["sensor"] is not None}
    shown = [r for r in rows if r["sensor"] is not None or (r["vehicle"], r["method"]) not in by_sensor]
    parts = []
    for (vehicle, method, day), of in groupby(shown, key=lambda r: (r["vehicle"], r["method"], r["day"])):
        own, last = list(of), signed.get(vehicle)
        lines = list(_vehicle(f"{vehicle}, {day}, {method}", own))
        if last is not None:
            is_this = last.state_key == own[0]["work_key"]
            which = "signed off" if is_this else f"not signed off; signed off is the state of {last.day},"
            by = f"  {which} by {last.signed_by} at {last.asserted_at[:16]} UTC {last.note}".rstrip()
            lines[1:1] = wrap(by, _WIDTH, subsequent_indent=" " * _INDENT)
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _vehicle(title: str, rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    own = [row for row in rows if row["child_frame"] != row["parent_frame"]]
    load = [_name(row) for row in own if row["status"] == "current"]
    keep = [_name(row) for row in own if row["status"] != "current"]
    advice = [f"load {', '.join(load)}"] if load else []
    advice += [f"keep {', '.join(keep)} at the prior"] if keep else []
    yield from wrap(f"{title}: {'; '.join(advice) or 'nothing to load'}", _WIDTH)
    for row in own:
        yield from _sensor(row)


def _name(row: dict[str, Any]) -> str:
    """The sensor of a row, or both ends of an edge."""
    return str(row["sensor"] or f"{row['parent_frame']}-{row['child_frame']}")


def _sensor(row: dict[str, Any]) -> Iterator[str]:
    days = row["days"]
    of_days = f", {len(days)} days from {days[0]} to {days[-1]}" if days[1:] else ", ".join(["", *days])
    yield f"  {row['parent_frame']} -> {row['child_frame']}: {row['status']}{of_days}"
    T, T_prior = row["T"], row["T_prior"]
    lines = []
    if T is not None:
        lines.append(f"qw qx qy qz {numbers(to_quaternion(T), '.6f')}")
        lines.append(f"x y z {numbers(T[:3, 3], '.4f')} m")
    if T is not None and T_prior is not None and row["status"] == "current":
        change = change_between(T_prior, T)
        turn, shift = numbers(np.degrees(change[:3]), "+.3f"), numbers(change[3:], "+.3f")
        lines.append(f"from the prior (tf of the logs, or a file): {turn} deg, {shift} m")
    if row["azimuth_sigma_rad"] is not None:
        azimuth, elevation = np.degrees([row["azimuth_sigma_rad"], row["elevation_sigma_rad"]])
        lines.append(f"sigma of azimuth {azimuth:.3f} deg, of elevation {elevation:.3f} deg")
    for text in (*lines, row["in_words"], row["reason"]):
        yield from wrap(text, _WIDTH, initial_indent=" " * _INDENT, subsequent_indent=" " * (_INDENT + 2))
