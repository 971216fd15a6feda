"""The study on a real day: whose lines count, and what its tables say of sigmas."""

import json
from argparse import Namespace

import numpy as np
import pytest

from pipeline.store.partitions import Partition
from tests.benchmarks import recovery


def line(seed, z, commit="aaa", observable=True) -> dict:
    """A run whose camera-lidar record is z sigmas off in every degree of freedom."""
    sigma = np.array([0.01] * 3 + [0.02] * 3)
    pair = {"error": (z * sigma).tolist(), "error_sigma": sigma.tolist(), "observable": [observable] * 6}
    return {
        "method": "joint",
        "start": "5,0.2",
        "seed": seed,
        "part": "day",
        "commit": commit,
        "pairs": {"camera_lidar": pair},
    }


def row(text: str, name: str) -> list[str]:
    found = next(r for r in text.splitlines() if f"| {name} |" in r)
    return [cell.strip() for cell in found.strip("|").split("|")][4:]


def test_the_sigma_table_counts_runs_inside_one_and_three_sigma():
    text = recovery.sigma_table([line(k, z) for k, z in enumerate((0.5, -0.5, 2.0, 4.0))])
    assert row(text, "rz") == [
        "4",
        "4",
        f"{np.degrees(0.015):+.3f}",
        f"{np.degrees(0.01):.3f}",
        "+1.50",
        "50 %",
        "75 %",
    ]
    assert row(text, "ty")[2:4] == ["+0.030", "0.020"]
    assert row(text, "all determined") == ["4", "24", "", "", "", "50 %", "75 %"]


def test_what_the_day_does_not_determine_is_in_no_total():
    text = recovery.sigma_table([line(0, 0.5), line(1, 9.0, observable=False)])
    assert row(text, "rz")[:2] == ["2", "1"]
    assert row(text, "all determined") == ["2", "6", "", "", "", "100 %", "100 %"]


@pytest.mark.parametrize(
    ("accepted", "counted"), [([], ["bbb"]), (["aaa"], ["aaa", "bbb"]), (["all"], ["aaa", "bbb"])]
)
def test_runs_of_an_older_commit_are_not_done(tmp_path, accepted, counted):
    out = tmp_path / "r.jsonl"
    out.write_text(
        "".join(json.dumps(line(k, 0.0, commit)) + "\n" for k, commit in enumerate(("aaa", "bbb")))
    )
    known = recovery._known(Namespace(out=out, accept_commits=accepted), "bbb")
    assert [r["commit"] for r in known] == counted


def test_an_adopted_day_knows_which_commit_perceived_it(tmp_path):
    (tmp_path / "done.json").write_text('{"perceived_by": "abc"}')
    assert recovery.perceived_by(tmp_path / "lake", Partition("v", "2026-03-02")) == "abc"
    assert recovery.perceived_by(tmp_path / "other" / "lake", Partition("v", "2026-03-02")) == "unknown"
