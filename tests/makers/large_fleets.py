"""A fleet of any size for its page: a dozen vehicles of all kinds, audited, and then repeated under other names."""

from dataclasses import replace

import numpy as np

from pipeline.report.verdicts import ChartVerdicts, FleetVerdicts, read_verdicts
from pipeline.report.window import FleetWindow, read_window
from pipeline.store.commits import commit_records
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.makers.stages import audit_fleet

__all__ = ["KINDS", "repeated", "some_of_each_kind"]

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])
# Motion of a sensor from a day on, statuses of days, days that are driven; one of a dozen is knocked.
KINDS = {
    "radar-knocked": ({"radar": KNOCK}, {}, 1),
    "camera-knocked": ({"camera": KNOCK[[1, 2, 0, 3, 4, 5]] / 3}, {}, 1),
    "last-day-alone": ({"radar": KNOCK}, {}, 1),
    "held": ({}, {2: "held", 5: "refused", 6: "held", 9: "held"}, 1),
    "weekly": ({}, {}, 7),
    **{f"good-{k}": ({}, {3: "held"} if k % 3 else {}, 1) for k in range(7)},
}


def some_of_each_kind(lake, fleet, days=28, seed=21):
    """A lake with one vehicle of each kind, audited: (window, verdicts)."""
    rng, rows = np.random.default_rng(seed), []
    for kind, (motion, statuses, every) in KINDS.items():
        begin = days - 1 if kind == "last-day-alone" else days // 2
        rows += [
            r
            for r in vehicle_records(
                kind, days, rng, motion=lambda d, m=motion, b=begin: m if d >= b else {},
                status=lambda d, s=statuses: s.get(d, "accepted"),
            )
            if int(r.day[-2:]) % every == 0
        ]  # fmt: skip
    commit_records(lake, CALIBRATIONS, rows)
    audit_fleet(lake, fleet)
    return read_window(lake, "joint", days, "2100-01-01"), read_verdicts(lake, "joint")


def repeated(window, verdicts, count, rare=25):
    """The fleet as `count` vehicles, `rare` times as many of them good as of any other kind."""
    kinds = [k for k in KINDS for _ in range(rare if k.startswith("good") else 1)]
    names = [f"{kinds[i % len(kinds)].split('-')[0]}-{i:05d}" for i in range(count)]
    names = sorted(zip(names, (kinds[i % len(kinds)] for i in range(count)), strict=True))
    rows = [np.flatnonzero(window.owner == window.vehicles.index(kind)) for _, kind in names]
    charts = [np.flatnonzero(verdicts.charts.owner == verdicts.vehicles.index(kind)) for _, kind in names]
    at, on = np.concatenate(rows), np.concatenate(charts)
    owner, chart_owner = (np.repeat(np.arange(count), [len(r) for r in of]) for of in (rows, charts))
    c = verdicts.charts
    return (
        FleetWindow(
            [name for name, _ in names], window.edges, owner, window.day[at], window.edge[at], window.status[at],
            window.T[at], window.sigma[at], window.observable[at], [window.work_key[i] for i in at],
            window.code_versions,
        ),
        FleetVerdicts(
            [name for name, _ in names],
            {name: [replace(f, vehicle=name) for f in verdicts.findings[kind]] for name, kind in names},
            ChartVerdicts(c.edges, chart_owner, c.edge[on], c.dof[on], c.status[on], c.limit[on], c.start[on]),
            verdicts.audited,
            verdicts.work_keys,
        ),
    )  # fmt: skip
