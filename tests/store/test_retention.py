"""Images leave the lake after their time; what rests on them stays, and the same logs are not taken for new ones."""

import datetime as dt
import json
from dataclasses import replace

import numpy as np
import pytest

from jobs.upkeep import gc
from pipeline.core.config import load_fleet
from pipeline.core.errors import CollectedError, ConfigError
from pipeline.core.runner import Stage
from pipeline.core.stage_work import Task, Work
from pipeline.report.reading import has_frames
from pipeline.store.moments import sensor_files
from pipeline.store.partitions import Lake, Partition, days_after
from pipeline.store.repair import collect
from pipeline.store.tables import read_columns
from pipeline.store.views import frames_of, ingested, observations_of
from schemas.captures import CAPTURES
from schemas.moments import MOMENTS
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import joined_of, write_frames, write_observations
from tests.makers.table_rows import make_frame, make_observation

OLD, NEW = Partition("car", "2026-03-02"), Partition("car", "2026-03-20")


@pytest.fixture
def lake(tmp_path):
    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(0)
    for partition in (OLD, NEW):
        write_frames(lake, partition, [make_frame(rng, free=400, frame_index=i) for i in range(3)])
        seen = [make_observation(rng, free=400, frame_index=i) for i in range(3)]
        write_observations(lake, partition, seen)
    return lake


def frames_before(lake):
    return list(collect(lake, MOMENTS, "2026-03-10", "2026-04-01"))


def test_old_frames_leave_with_their_bytes_and_nothing_else_does(lake):
    files = [lake.file("moments", OLD), *sensor_files(lake, MOMENTS, OLD)]
    assert len(files) == 4
    size = sum(file.stat().st_size for file in files)
    [gone] = frames_before(lake)
    assert (gone.partition, gone.freed_bytes) == (OLD, size)
    assert [file.exists() for file in files] == [True, False, False, False]
    with pytest.raises(CollectedError, match=r"were deleted on 2026-04-01: ingest the day's logs again"):
        next(frames_of(lake, OLD))
    with pytest.raises(CollectedError):
        read_columns(lake, MOMENTS, OLD, ["moment"])
    assert len(list(frames_of(lake, NEW))) == 3
    manifest = ingested(lake, OLD)
    assert (manifest.rows, manifest.work_key, manifest.kept) == (3, "frames-key", {"frames": 3})
    assert len(list(observations_of(lake, OLD))) == 3
    assert not has_frames(lake, OLD)
    assert has_frames(lake, NEW)
    assert frames_before(lake) == []


def test_damaged_files_go_as_a_whole_after_the_same_time(lake):
    path = lake.file("moments", OLD)
    path.write_bytes(path.read_bytes()[:50])
    aside = path.parent / "part-0.parquet.damaged"
    aside.write_bytes(b"x")
    frames_before(lake)
    assert not path.exists()
    assert not aside.exists()
    assert sensor_files(lake, MOMENTS, OLD) == []
    assert "damaged" in lake.damage[0]


def test_the_same_logs_are_up_to_date_after_their_images_left(lake, tmp_path, monkeypatch):
    (tmp_path / "fleet.toml").write_text(fleet_toml("car"))
    task = Task(load_fleet(tmp_path / "fleet.toml"), lake, OLD)
    rng = np.random.default_rng(1)
    made = Work(({"a": 1},), lambda _run: (joined_of(make_frame(rng, frame_index=i)) for i in range(2)))
    monkeypatch.setattr(Stage, "load", lambda _: lambda _task: replace(made))
    stage = Stage("ingest", (), (MOMENTS, *CAPTURES.values()), "")
    done = stage.run(task)
    frames_before(lake)
    cached = stage.run(task)
    assert (cached.status, cached.rows, cached.kept) == ("cached", 2, done.kept)


def test_the_command_takes_images_and_pages_and_says_how_much(lake, capsys):
    today = dt.datetime.now(dt.UTC).date()
    recent, past = (days_after(today.isoformat(), -n) for n in (29, 30))  # thirty days are kept with today
    pages = lake.root / "report" / "fleet_days"
    for name in ("2026-03-02/car.html", f"{recent}/car.html", f"{past}/car.html", "index.html"):
        (pages / name).parent.mkdir(parents=True, exist_ok=True)
        (pages / name).touch()
    assert gc(lake=str(lake.root), dry_run=True) == 0
    planned = json.loads(capsys.readouterr().out)
    assert len(list(frames_of(lake, OLD))) == 3  # a dry run takes nothing
    assert gc(lake=str(lake.root)) == 0
    done = json.loads(capsys.readouterr().out)
    assert (planned["status"], done["status"]) == ("planned", "done")
    assert all(planned[k] == done[k] for k in ("partitions", "freed_bytes", "pages"))
    assert (done["partitions"], done["pages"]) == ({"moments": 2}, 2)
    assert done["freed_bytes"] > 0
    assert sorted(p for p in pages.rglob("*.html")) == [pages / recent / "car.html", pages / "index.html"]
    assert gc(lake=str(lake.root), observations_days=1) == 0
    assert json.loads(capsys.readouterr().out)["partitions"] == {"moments": 0, "perceived": 2}
    with pytest.raises(ConfigError, match="images-days"):
        gc(lake=str(lake.root), images_days=0)
    with pytest.raises(ConfigError, match="no such folder"):
        gc(lake=str(lake.root / "x"))
