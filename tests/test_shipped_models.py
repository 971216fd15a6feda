"""`boresight models`: every model in the package has a card that speaks of this very file."""

import json
import shutil

import pytest

from jobs.cli import main
from pipeline.learn.infer.onnx_networks import SHIPPED
from pipeline.shipped_models import REQUIRED, shipped_models


def test_every_shipped_model_is_the_file_that_its_card_speaks_of(capsys):
    found = shipped_models()
    assert "joint" in {model.name for model in found}
    assert {model.name: model.problems for model in found if model.problems} == {}
    assert main(["models", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [m["name"] for m in told["models"]] == [model.name for model in found]
    assert all(set(REQUIRED) <= m.keys() for m in told["models"])


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
    monkeypatch.setattr("pipeline.shipped_models.Path", lambda _: tmp_path / "models.py")
    assert main(["models"]) == 1
    assert "joint" in capsys.readouterr().err
