"""Sign-off of states: a person approves one for loading; the last sign-off counts, the ones before stay recorded."""

from __future__ import annotations

from pipeline.core.errors import ConfigError
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, work_key
from pipeline.store.records import read_records
from schemas.sign_offs import SIGN_OFFS, SignOff
from schemas.states import StateRow

__all__ = ["read_sign_offs", "sign"]


def read_sign_offs(lake: Lake, method: str, vehicle: str | None = None) -> list[SignOff]:
    """Sign-offs of states of a method, the oldest first."""
    found = sorted(read_records(lake, SIGN_OFFS, SignOff, vehicle=vehicle), key=lambda s: s.asserted_at)
    return [s for s in found if s.method == method]


def sign(lake: Lake, state: list[StateRow], name: str, note: str = "") -> None:
    """Record that a person approved a vehicle's state; ConfigError without a state or a name."""
    if not state or not name.strip():
        raise ConfigError(
            "command line", "sign-off", "needs a state of the vehicle, and the name of a person"
        )
    of, count = state[0], len(read_sign_offs(lake, state[0].method, state[0].vehicle))
    about = {"vehicle": of.vehicle, "day": of.day, "method": of.method, "state_key": of.work_key}
    key = work_key("sign-off", "", f"{of.vehicle} {count}", [of.work_key, name, note])  # a row each time
    commit_records(lake, SIGN_OFFS, [SignOff(**about, signed_by=name, note=note, work_key=key)])
