"""Simulated days that tests share: equal to days made anew, each caller's own, and never those of other sources."""

import subprocess
import sys
from pathlib import Path

from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from tests.makers import kept_days
from tests.makers.kept_days import kept_fleet, sources_of

ONE = {"vehicles": 1, "days": 1, "frames": 1, "drives": 1}
SPEC = FleetSpec(**ONE)


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_kept_day_is_the_day_that_would_be_made_and_a_change_of_a_copy_stays_there(tmp_path, monkeypatch):
    monkeypatch.setattr(kept_days, "KEPT", tmp_path / "kept")
    simulate_fleet(SPEC, tmp_path / "made")
    kept_fleet(SPEC, tmp_path / "first")
    monkeypatch.delattr(kept_days, "simulate_fleet")  # the second one is not made
    (tmp_path / "first" / "fleet.toml").write_text("")
    kept_fleet(SPEC, tmp_path / "second")
    made = contents(tmp_path / "made")
    assert contents(tmp_path / "second") == made
    assert contents(tmp_path / "first") != made
    assert {p.suffix for p in made} == {".mcap", ".json", ".toml"}
    assert not list((tmp_path / "kept").glob("*/making-*"))


def test_a_changed_source_is_another_key(monkeypatch, tmp_path):
    key = kept_days.of_sources.__wrapped__
    before, files = key(), sources_of("pipeline.simulate.fleet")
    assert key() == before
    changed = tmp_path / "changed.py"
    changed.write_bytes(files[-1].read_bytes() + b"#")
    monkeypatch.setattr(kept_days, "sources_of", lambda _: [*files[:-1], changed])
    assert key() != before


def test_no_file_is_loaded_to_make_a_day_that_is_not_among_its_sources(tmp_path):
    code = f"""
import sys
from pathlib import Path
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
simulate_fleet(FleetSpec(**{ONE}), Path({str(tmp_path)!r}))
print(*(m.__file__ for n, m in sys.modules.items() if n.partition(".")[0] in ("pipeline", "schemas")), sep="\\n")
"""
    from_repo = subprocess.run(
        [sys.executable, "-c", code], cwd=kept_days.REPO, capture_output=True, text=True, check=True
    )
    loaded = {Path(line) for line in from_repo.stdout.splitlines()}
    assert len(loaded) > 30
    assert loaded <= set(sources_of("pipeline.simulate.fleet"))
