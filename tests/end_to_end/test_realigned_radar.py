"""A radar's software turns its points by 0.3 deg: from logs to the night that finds it, and blames no mount."""

import json

import pytest

from jobs.cli import main
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, day_names, simulate_fleet
from pipeline.store.current import current_drift, current_events
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import SERVICE_EVENTS, ServiceEvent

STEP, NAMES = 3, day_names("2026-03-02", 5)  # the first day on which it measures otherwise
FRAMES = 16  # fewer leave too few to fit


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Logs of one vehicle for five days, town and highway in turn."""
    out = tmp_path_factory.mktemp("realigned")
    faults = parse_faults(f"vehicle-1:{STEP}:radar:realign:0.3", NAMES)
    simulate_fleet(
        FleetSpec(vehicles=1, days=len(NAMES), frames=FRAMES, drives=2, faults=faults, seed=41), out
    )
    return out


def night(fleet, last_day, capsys):
    """Summary, and findings, of the night after a day."""
    where = ["--fleet", f"{fleet}/fleet.toml", "--lake", f"{fleet}/lake"]
    logs = ["--logs", f"{fleet}/logs/{{vehicle}}/{{day}}/*"]
    code = main(
        ["nightly", *where, *logs, "--to", last_day, "--executor", "inline", "--no-pictures", "--seed", "1"]
    )
    assert code in (0, 3)
    findings = current_drift(read_records(Lake.at(fleet / "lake"), DRIFT, DriftFinding))
    return json.loads(capsys.readouterr().out.splitlines()[-1]), [f for f in findings if f.day == last_day]


@pytest.mark.slow
def test_a_silent_re_alignment_is_found_the_same_night_and_blamed_on_the_radars_software(fleet, capsys):
    before, _ = night(fleet, NAMES[STEP - 1], capsys)
    assert "realigned" not in before

    that_night, findings = night(fleet, NAMES[STEP], capsys)
    [told] = that_night["realigned"]
    assert (told["vehicle"], told["sensor"]) == ("vehicle-1", "radar")
    assert told["what"].startswith(f"{NAMES[STEP]}: +0.3")
    assert "its edges turned by -0." in told["what"]
    assert findings
    assert not [f for f in findings if f.status == "RED" or f.moved_sensor]

    after, findings = night(fleet, NAMES[-1], capsys)
    assert "realigned" not in after
    assert not [f for f in findings if f.status == "RED" or f.moved_sensor]
    [event] = current_events(read_records(Lake.at(fleet / "lake"), SERVICE_EVENTS, ServiceEvent))
    assert (event.kind, event.sensor, event.day) == ("re-alignment", "radar", NAMES[STEP - 1])
