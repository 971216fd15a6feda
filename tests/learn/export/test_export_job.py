"""`boresight export onnx`: a run's best weights become a file that runs, with a card that says where they come from."""

import json
import shutil

import pytest
import torch

from jobs.cli import main
from pipeline.core.config import LearnConfig, PrepareConfig
from pipeline.learn.infer.onnx_networks import OnnxNetwork, open_networks
from pipeline.learn.network.calibration_network import build_network
from pipeline.learn.train.loop import BEST, LAST, load_checkpoint, save_checkpoint
from pipeline.learn.train.settings import TrainConfig


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """What training leaves, in little."""
    folder = tmp_path_factory.mktemp("run")
    config = TrainConfig(architecture="concat", width=8, hidden=16, seed=7)
    network = build_network(config.network)
    with torch.no_grad():
        network.core.heads.layers["lidar_radar"].bias[2] = 1.0
    state = {"config": config.model_dump(mode="json"), "network": network.state_dict()}
    save_checkpoint(folder / BEST, state | {"step": 40, "judged": 1.0})
    save_checkpoint(folder / LAST, state | {"step": 60, "trained_s": 120.0})
    reports = ({"step": step, "validation/loss": loss} for step, loss in ((20, 3.0), (40, 2.0), (60, 9.0)))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in reports))
    return folder


def test_a_run_becomes_a_file_with_its_card(run, tmp_path, capsys):
    notes = tmp_path / "notes.json"
    notes.write_text('{"held_out_days": {"azimuth_deg": 0.1}}')
    out = tmp_path / "model.onnx"
    assert main(["export", "onnx", "--run", str(run), "--out", str(out), "--notes", str(notes)]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary["outputs"] == [str(out), str(tmp_path / "model.json"), str(tmp_path / "model.md")]
    calibrator = OnnxNetwork(out)
    assert calibrator.config.architecture == "concat"
    card = json.loads(calibrator.metadata["card"])
    assert card["weights"].startswith("of step 40, the best")
    assert card["results"] == {"loss": 2.0}  # of the step whose weights these are
    assert card["seeds"] == [7]
    assert card["time"] == {"steps": 60, "minutes": 2.0}
    assert card["held_out_days"] == {"azimuth_deg": 0.1}
    assert card["limits"]


@pytest.mark.parametrize(
    ("best", "why"), [(40, None), (0, "did not improve"), (None, "not validated on held-out frames")]
)
def test_a_network_that_held_out_frames_did_not_choose_is_called_unfit_wherever_it_goes(
    run, tmp_path, capsys, best, why
):
    folder, notes = shutil.copytree(run, tmp_path / "run"), tmp_path / "notes.json"
    save_checkpoint(folder / BEST, load_checkpoint(run / BEST) | {"step": best})
    if best is None:
        (folder / BEST).unlink()
    notes.write_text('{"limits": ["none"]}')  # which nobody can claim
    out = tmp_path / "m.onnx"
    called = ["export", "onnx", "--run", str(folder), "--out", str(out), "--notes", str(notes)]
    assert main(called) == (0 if why is None else 3)
    assert ('"reason": "Not fit for use' in capsys.readouterr().out) == (why is not None)
    card = json.loads((tmp_path / "m.json").read_text())
    assert card["limits"][-1] == "none"
    [network] = open_networks({"joint": out}, LearnConfig(), PrepareConfig())
    assert (why or "") in network.unfit
    assert bool(network.unfit) == (why is not None)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--out", "m.onnx"], "run"),
        (["--out", "m.onnx", "--run", "nowhere"], "run"),
        (["--out", "m.bin", "--run", "{run}"], "out"),
        (["--out", "m.onnx", "--run", "{run}", "--notes", "missing.json"], "missing.json"),
    ],
)
def test_what_cannot_be_exported_is_refused_with_the_reason(
    run, tmp_path, monkeypatch, capsys, options, word
):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "onnx", *(o.format(run=run) for o in options)]) == 2
    assert word in json.loads(capsys.readouterr().out.splitlines()[-1])["reason"]
    assert not list(tmp_path.iterdir())
