"""Failures that no retry can fix: fleet.toml, a file that it names, or the recording must be corrected."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.core.config import FleetConfig
from pipeline.fleet.nightly import DayOutcome

__all__ = ["night_statuses", "to_mend", "vehicles_to_mend"]


def to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """What must be corrected: by rig if all of its days in this night are misconfigured, and by unknown vehicle.

    A rig's correction is that of its first day.
    """
    of_rig: dict[str, list[DayOutcome]] = {}
    for outcome in outcomes:
        of_rig.setdefault(_section(outcome, fleet), []).append(outcome)
    return {rig: own[0].mend for rig, own in of_rig.items() if all(o.mend for o in own)}


def vehicles_to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """What must be corrected by vehicle: more days do not help before."""
    mend = to_mend(outcomes, fleet)
    return {o.vehicle: mend[section] for o in outcomes if (section := _section(o, fleet)) in mend}


def night_statuses(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> list[str]:
    """Status of each vehicle-day; "misconfigured" if a retry does not help.

    A day that failed because of its configuration is misconfigured. Another day counts only if all days of
    the rig have something to correct: a single log without a topic is no error of fleet.toml.
    """
    mend = to_mend(outcomes, fleet)
    return [
        "misconfigured" if o.mend and (o.status == "failed" or _section(o, fleet) in mend) else o.status
        for o in outcomes
    ]


def _section(outcome: DayOutcome, fleet: FleetConfig) -> str:
    """Name of the vehicle's rig, or the section of fleet.toml that an unknown vehicle lacks."""
    known = fleet.knows(outcome.vehicle)
    return fleet.vehicle(outcome.vehicle).rig if known else f'vehicles."{outcome.vehicle}"'
