"""The commands around the stage: exit codes, and one JSON summary as the last line of stdout."""

import json

import pytest

from jobs.check import check
from jobs.ingest import ingest
from pipeline.core.errors import ConfigError
from tests.makers.fleet_files import fleet_toml


@pytest.fixture
def fleet(tmp_path):
    path = tmp_path / "fleet.toml"
    text = fleet_toml("car", radar='doppler_positive = "approaching"')
    path.write_text(text.replace("default", "trio"))  # the only rig needs no name of its own
    return path


def last_line(capsys):
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def test_ingest_exits_0_when_done_or_cached_and_3_when_refused(kit, tmp_path, fleet, capsys):
    log = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    common = {"fleet": fleet, "lake": str(tmp_path / "lake"), "vehicle": "car", "day": "2023-11-14"}
    for status in ("done", "cached"):
        assert ingest(str(log), **common) == 0
        summary = last_line(capsys)
        assert (summary["command"], summary["status"], summary["rows"]) == ("ingest", status, 4)
    image_alone = kit.Kit().drive().without(kit.LIDAR).without(kit.RADAR).mcap(tmp_path / "b.mcap")
    assert ingest(str(image_alone), **common) == 3
    assert kit.LIDAR in last_line(capsys)["reason"]
    with pytest.raises(ConfigError, match="at least one log"):
        ingest(**common)


def test_check_exits_0_1_2_for_yes_partly_no(kit, tmp_path, fleet, capsys):
    good = kit.Kit(frames=40).drive()
    assert check(fleet, good.mcap(tmp_path / "good.mcap"), json=True) == 0
    report = json.loads(capsys.readouterr().out)  # one object on stdout
    assert report["answer"] == "yes"
    assert {v["pair"] for v in report["verdicts"]} == {"camera_lidar", "lidar_radar", "camera_radar"}
    assert report["sync"]["moments"] == 40
    assert check(fleet, good.without(kit.LABELS).mcap(tmp_path / "unlabelled.mcap")) == 1
    printed = capsys.readouterr()
    assert "radar elevation: yes" in " ".join(printed.err.split())
    summary = json.loads(printed.out.splitlines()[-1])
    assert summary["status"] == "partly"
    assert "boresight nightly" in summary["next_steps"][-1]
    assert summary["pairs"] == {"camera_lidar": "no", "lidar_radar": "partly", "camera_radar": "no"}
    assert check(fleet, good.without(kit.RADAR).mcap(tmp_path / "blind.mcap")) == 2
    assert kit.RADAR in capsys.readouterr().err
    with pytest.raises(ConfigError, match="no rig"):
        check(fleet, tmp_path / "good.mcap", rig="truck")
