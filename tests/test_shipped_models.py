"""`boresight models`: every model in the package has a card that speaks of this very file."""

import json
import shutil

import pytest

from jobs.cli import main
from pipeline.core.models import REQUIRED, SHIPPED, shipped_models
from tests.makers.training_lakes import fleet_of


def test_every_shipped_model_is_the_file_that_its_card_speaks_of(capsys):
    found = shipped_models()
    assert "joint" in {model.name for model in found}
    assert {model.name: model.problems for model in found if model.problems} == {}
    assert main(["models", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [m["name"] for m in told["models"]] == [model.name for model in found]
    assert all(set(REQUIRED) <= m.keys() for m in told["models"])
    assert main(["models"]) == 0
    printed = " ".join(capsys.readouterr().err.split())
    assert "[learn] camera" in printed
    assert all(f"{model.file.stat().st_size / 1e6:.1f} MB" in printed for model in found)


@pytest.mark.parametrize("spoil", ["file", "card", "missing"])
def test_another_file_or_a_card_that_lacks_something_is_told(spoil, tmp_path, capsys, monkeypatch):
    for suffix in (".onnx", ".json", ".md"):
        shutil.copy(SHIPPED / f"joint{suffix}", tmp_path)
    assert shipped_models(tmp_path)[0].problems == ()
    card = tmp_path / "joint.json"
    if spoil == "file":
        with (tmp_path / "joint.onnx").open("ab") as stream:
            stream.write(b"\0")
    elif spoil == "card":
        card.write_text(json.dumps({k: v for k, v in json.loads(card.read_text()).items() if k != "license"}))
    else:
        card.unlink()
    (problem,) = shipped_models(tmp_path)[0].problems
    assert {"file": "another file", "card": "license", "missing": "no readable card"}[spoil] in problem
    monkeypatch.setattr("pipeline.core.models.Path", lambda _: tmp_path / "models.py")
    assert main(["models"]) == 1
    assert "joint" in capsys.readouterr().err


def test_fleet_toml_names_what_ships_by_a_word_and_files_of_its_own_by_their_path(tmp_path):
    fleet = fleet_of(["a"]).read_from(tmp_path / "fleet.toml")
    assert fleet.path_of("shipped:radar_drivable") == SHIPPED / "radar_drivable.toml"
    assert fleet.path_of("radar_drivable.toml") == tmp_path / "radar_drivable.toml"
