"""Claims about a data set, registered before its logs are checked, and their outcomes.

A file of claims is registered with its hash, its text and the time before the first log is opened. A
registered claim stays on the page even if the file changes or disappears. It counts if no log had been
checked before and the file is unchanged.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline.errors import ConfigError
from pipeline.store.atomic_write import atomic_write
from pipeline.verify.rates import Look, interval

__all__ = ["judged_claims", "register"]

_OF_TURNS = {"caught": "wrong", "missed": "right", "left open": "undecided"}


class _Claim(BaseModel):
    """At least or at most a given share of the looks at a sensor has the given answer."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    text: str = Field(min_length=1)  # in words
    # As shipped: right, wrong, undecided; of turned sensors: caught (wrong), missed (right), left open (undecided).
    answer: Literal["right", "wrong", "undecided", "caught", "missed", "left open"]
    sensor: str | None = None
    axis: str | None = None  # of the turns
    deg: float | None = None  # size of the turns
    at_least: float | None = Field(default=None, ge=0, le=1)
    at_most: float | None = Field(default=None, ge=0, le=1)

    @model_validator(mode="after")
    def _bounded(self) -> _Claim:
        if (self.at_least is None) == (self.at_most is None):
            raise ValueError("give either at_least or at_most")
        if self.answer not in _OF_TURNS and (self.deg is not None or self.axis is not None):
            raise ValueError("deg and axis are of turns: caught, missed, left open")
        return self

    def is_about(self, look: Look) -> bool:
        row = look.row
        if self.sensor not in {None, row.sensor}:
            return False
        if self.answer not in _OF_TURNS:
            return not row.turn
        is_size = self.deg is None or round(abs(row.turn_deg) - self.deg, 6) == 0
        return look.is_turned and not look.was_wrong and self.axis in {None, row.turn_axis} and is_size


def register(kept: Path, claims: Path | None, asked_before: int) -> list[dict[str, Any]]:
    """All registered files; the file of this run is added if none was registered at its path before.

    Args:
        kept: file in which registered claims are stored.
        claims: file of this run; None = only those of earlier runs.
        asked_before: number of logs that have been checked already.

    Raises:
        ConfigError: the file of this run cannot be read or holds no valid claims.
    """
    known: list[dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else []
    if claims is None or str(claims.resolve()) in {r["path"] for r in known}:
        return known
    try:
        text = claims.read_text()
    except (OSError, ValueError) as err:
        raise ConfigError(str(claims), "", f"cannot be read: {err}") from err
    _claims(text, str(claims))
    now = dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    about = {"path": str(claims.resolve()), "sha256": _hash(text), "registered_at": now}
    known.append({**about, "asked_before": asked_before, "text": text})
    kept.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(kept) as stream:
        stream.write(json.dumps(known, indent=1).encode())
    return known


def judged_claims(registered: Sequence[Mapping[str, Any]], looks: Sequence[Look]) -> list[dict[str, Any]]:
    """Every registered claim: `verdict` holds, refuted, not tested or not counted, its share and the reason."""
    return [
        {**r, "claim": claim.text, **_judged(claim, looks, _why_not(r))}
        for r in registered
        for claim in _claims(r["text"], r["path"])
    ]


def _claims(text: str, path: str) -> list[_Claim]:
    """The claims of a TOML text with [[claims]]; ConfigError names an invalid claim."""
    try:
        entries = tomllib.loads(text).get("claims")
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(path, "", f"is no TOML: {err}") from err
    if not isinstance(entries, list) or not entries:
        raise ConfigError(path, "claims", "has no [[claims]]")
    found = []
    for number, entry in enumerate(entries):
        try:
            found.append(_Claim.model_validate(entry))
        except ValidationError as err:
            first = err.errors()[0]
            raise ConfigError(
                path, ".".join(map(str, ("claims", number, *first["loc"]))), first["msg"]
            ) from err
    return found


def _judged(claim: _Claim, looks: Sequence[Look], why_not: str) -> dict[str, Any]:
    own = [k for k in looks if claim.is_about(k)]
    hits, trials = sum(k.row.answer == _OF_TURNS.get(claim.answer, claim.answer) for k in own), len(own)
    least, most = claim.at_least or 0.0, 1.0 if claim.at_most is None else claim.at_most
    bound = f"at most {most:.0%}" if claim.at_least is None else f"at least {least:.0%}"
    low, high = interval(hits, trials) if trials else (0.0, 1.0)
    verdict = "not tested" if not trials else "holds" if least <= hits / trials <= most else "refuted"
    reason = why_not
    if verdict == "refuted" and not why_not and high >= least and low <= most:
        reason = "so few looks that chance could have done it"
    told = {
        "of": f"{claim.answer}, {bound}",
        "hits": hits,
        "trials": trials,
        "interval": (low, high),
        "reason": reason,
    }
    return told | {"verdict": "not counted" if why_not else verdict, "as_registered": verdict}


def _why_not(registered: Mapping[str, Any]) -> str:
    """Reason why the claims of a file do not count; empty if they do.

    If the file is missing, the stored text counts.
    """
    if registered["asked_before"]:
        return f"registered after {registered['asked_before']} logs had been checked"
    file = Path(registered["path"])
    is_same = not file.exists() or hashlib.sha256(file.read_bytes()).hexdigest() == registered["sha256"]
    return "" if is_same else "the file changed after the run began"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
