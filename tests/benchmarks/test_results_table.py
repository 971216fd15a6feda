"""What the README states is what the result files give, row by row."""

import re

import pytest

from tests.benchmarks import results_table
from tests.benchmarks.results_measures import MEASURES, interval, rate
from tests.benchmarks.results_table import TARGETS, WIDEST, written


@pytest.mark.parametrize("path", TARGETS, ids=lambda path: str(path.relative_to(path.parents[0])))
def test_a_readmes_results_are_what_the_files_give(path):
    assert written(path, TARGETS[path]) == path.read_text(), "make results"


def test_a_changed_result_changes_the_table(monkeypatch):
    [path] = [p for p, top_only in TARGETS.items() if top_only]
    monkeypatch.setitem(MEASURES, "accepted_days", lambda *_: "55 of 57")
    assert written(path, top_only=True) != path.read_text()


def test_the_readme_has_few_and_short_lines():
    [path] = [p for p, top_only in TARGETS.items() if top_only]
    lines = re.sub(r"\]\([^)]*\)", "]", path.read_text()).splitlines()
    assert len(lines) <= 100
    assert [line for line in lines if len(line) > WIDEST] == []


def test_a_rate_of_none_says_what_it_excludes():
    assert rate(0, 151) == "0 of 151 (< 2.0 %)"
    assert interval(0, 57)[1] == pytest.approx(1 - 0.05 ** (1 / 57))
    assert interval(57, 57)[0] == pytest.approx(0.05 ** (1 / 57))


def test_the_interval_of_a_rate_is_clopper_and_pearsons():
    # 8 of 10, as in every table of it.
    assert interval(8, 10) == (pytest.approx(0.4439, abs=1e-4), pytest.approx(0.9748, abs=1e-4))


def test_a_rate_over_nothing_is_refused():
    with pytest.raises(ValueError, match="3 of 2 is no rate"):
        rate(3, 2)


def test_days_that_were_calibrated_twice_count_once():
    day = {"rig": "paper", "environment": "urban", "seed": 4300}
    lines = [{"day": day, "spoil": spoil, "commit": "a"} for spoil in ("", "focal:0.03")]
    assert results_table._days(lines, {}) == "1"


def test_a_row_older_than_the_release_says_so(monkeypatch):
    monkeypatch.setattr(results_table, "release_now", lambda: "0.8.0")
    monkeypatch.setattr(results_table, "release_of", {"a": "0.8.0", "b": "0.7.0"}.__getitem__)
    assert results_table._release([{"commit": "a"}], {}) == "0.8.0"
    assert results_table._release([{"commit": "a"}, {"commit": "b"}], {}) == "0.7.0 to 0.8.0, older"


def test_a_second_look_at_a_seed_is_called_one():
    second = {"day": {"seed": 4216}, "commit": "f7aa0cd"}  # looked at by 8a615de before
    assert results_table._look([second], {}) == "second"
    assert results_table._look([second | {"commit": "8a615de"}], {}) == "first"
    assert results_table._look([{"day": {"seed": 171}, "commit": "a"}], {}) == "tuned on"


def test_what_make_benchmark_runs_can_be_begun():
    from tests.benchmarks.studies import nights, real, run, ssl

    assert all(fleet.spec.names for fleet in nights.FLEETS.values())
    assert {len(method) for method in real.STARTS} == {2}
    assert set(run.SUMMARIES) < set(run.SETS)
    assert all((ssl.RECIPES / recipe).is_file() for recipe, *_ in ssl.NETWORKS.values())
