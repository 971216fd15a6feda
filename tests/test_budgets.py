"""Budgets of lines and CPU time: every room has one, and what exceeds it is named."""

from pathlib import Path

from tests import budgets

FOLDERS = {p.name for p in Path(__file__).parent.iterdir() if p.is_dir() and any(p.rglob("test_*.py"))}


def test_every_room_and_every_folder_of_tests_has_a_budget():
    assert set(budgets.lines_of_rooms()) == set(budgets.BUDGETS["lines"])
    assert set(budgets.BUDGETS["quick_cpu_s"]) <= FOLDERS | {"files beside the folders"}


def test_what_is_larger_than_its_budget_or_has_none_is_named():
    assert budgets.beyond({"a": 9.0, "b": 11.0, "c": 1.0}, {"a": 10, "b": 10}) == [
        "b: 11, and tests/budgets.toml allows 10",
        "c: 1, and tests/budgets.toml allows 0",
    ]


def test_lint_fails_where_a_room_has_more_lines_than_its_budget(monkeypatch, capsys):
    assert budgets.main() == 0
    monkeypatch.setitem(budgets.BUDGETS["lines"], "jobs", 10)
    assert budgets.main() == 1
    assert capsys.readouterr().out.startswith("lines of jobs: ")
