"""Runs: that they resume to the bit, stop when told, refuse what cannot be right, and work in several processes."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from jobs.train import parse_duration
from pipeline.core.errors import ConfigError, ContractError
from pipeline.learn.export.onnx_file import card_of_run
from pipeline.learn.network.calibration_network import build_network
from pipeline.learn.prepare.inventory import doubts
from pipeline.learn.train.loop import (
    DivergedError,
    DivergenceGuard,
    load_checkpoint,
    read_metrics,
    save_checkpoint,
)
from pipeline.learn.train.run import TrainRequest, network_of_run
from pipeline.learn.train.run import train as run
from pipeline.learn.train.settings import TrainConfig, load_train_config
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_rows, write_partition
from schemas.training import TRAINING, TrainingRow
from tests.makers.processes import started
from tests.makers.training_lakes import WIDE, sample_of

# What a run does is the same for `concat`, whose step costs a fifth of one of `matching`.
SMALL = {"architecture": "concat", "width": 4, "hidden": 16, "batch_size": 2, "validate_every": 10}
DAY = Partition("vehicle-1", "2026-03-02")


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """What bit-exact means needs one order of additions."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def write_rows(lake, rows):
    """Table training, in row groups of two."""
    with write_partition(lake, TRAINING, DAY, "key") as writer:
        for first in range(0, len(rows), 2):
            writer.append(rows[first : first + 2])
        writer.describe(kept={}, rejected={})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Four frames to train on, and two held out."""
    lake = tmp_path_factory.mktemp("data")
    rows = [replace(sample_of(seed, grid=WIDE), reference="joint") for seed in range(6)]
    write_rows(Lake.at(lake), [replace(row, split="train" if i < 4 else "val") for i, row in enumerate(rows)])
    return str(lake)


def train(data, out, progress=lambda *_: None, start=None, **changes):
    """A run on this data; returns its result."""
    return run(TrainRequest(data, out, "cpu", start=start), config(**changes), progress)


def config(**changes):
    return TrainConfig.model_validate(SMALL | {"steps": 20, "log_every": 5} | changes)


def toml(folder, **changes):
    lines = (f"{key} = {json.dumps(value)}" for key, value in (SMALL | changes).items())
    (folder / "train.toml").write_text("\n".join(lines))
    return str(folder / "train.toml")


def reports(folder):
    """All reports, without what the clock decides."""
    return [{k: v for k, v in r.items() if k != "samples_per_s"} for r in read_metrics(folder)]


def stop_at(step):
    """Progress that sends this process SIGTERM when so many steps are done."""

    def report(done, _total, _what):
        if done == step:
            os.kill(os.getpid(), signal.SIGTERM)

    return report


def test_a_run_that_was_stopped_goes_on_to_the_same_bits(data, tmp_path):
    settings = {"architecture": "matching", "steps": 6, "log_every": 1, "validate_every": 3}
    whole = train(data, tmp_path / "whole", **settings)
    assert (whole.status, whole.step) == ("done", 6)
    half = train(data, tmp_path / "parts", stop_at(3), **settings)
    assert (half.status, half.step, half.signal) == ("stopped", 3, signal.SIGTERM)
    rest = train(data, tmp_path / "parts", **settings)
    assert (rest.status, rest.step) == ("done", 6)
    assert reports(tmp_path / "parts") == reports(tmp_path / "whole")
    a, b = (load_checkpoint(tmp_path / name / "last.pt") for name in ("whole", "parts"))
    for name, weight in a["network"].items():
        assert torch.equal(weight, b["network"][name]), name
    for key, values in a["optimiser"]["state"].items():
        assert all(torch.equal(v, b["optimiser"]["state"][key][n]) for n, v in values.items())
    assert (a["processes"], a["guard"], a["best"]) == (b["processes"], b["guard"], b["best"])


def test_a_finished_run_reports_falls_validates_and_gives_its_network(data, tmp_path):
    settings = {"architecture": "matching", "steps": 30, "log_every": 1, "validate_every": 15}
    settings["learning_rate"] = 1e-2
    train(data, tmp_path, **settings)
    trained = [r for r in reports(tmp_path) if "loss" in r]
    assert [r["step"] for r in trained] == list(range(1, 31))
    assert all(math.isfinite(v) for r in trained for v in r.values())
    assert trained[-1]["semantics"] < 0.9 * trained[0]["semantics"]  # the encoders learn what is easy
    assert trained[-1]["learning_rate"] < 0.02 * 1e-2  # the cosine has come down
    judged = [r for r in reports(tmp_path) if "validation/judged" in r]
    assert [r["step"] for r in judged] == [0, 15, 30]
    for axis in "xyz":  # by how much the mean of single frames' answers has moved
        mean, moved = (
            [r[f"validation/{n}_deg/camera_lidar/{axis}"] for r in judged] for n in ("mean", "moved")
        )
        assert moved == pytest.approx([value - mean[0] for value in mean])
    assert (tmp_path / "best.pt").exists()
    assert any((tmp_path / "events").iterdir())
    network, start = network_of_run(tmp_path, best=False), build_network(config(**settings).network)
    assert not network.training
    for part in ("camera_encoder", "lidar_encoder", "lidar_matcher", "radar_matcher", "heads"):
        ours, theirs = getattr(network.core, part).state_dict(), getattr(start.core, part).state_dict()
        assert any(not torch.equal(ours[name], theirs[name]) for name in ours), part
    again = train(data, tmp_path, **settings)
    assert (again.status, again.samples) == ("done", 0)
    with pytest.raises(ConfigError, match="seed"):
        train(data, tmp_path, **settings, seed=5)


def test_a_checkpoint_that_is_worse_than_the_start_is_not_kept(data, tmp_path):
    settings = {"steps": 10, "learning_rate": 0.3, "gradient_norm": 1e6, "diverged_factor": 1e6}
    train(data, tmp_path, **settings)
    before, after = (r["validation/judged"] for r in reports(tmp_path) if "validation/judged" in r)
    assert after > before
    kept, start = network_of_run(tmp_path), build_network(config(**settings).network)
    assert all(torch.equal(a, b) for a, b in zip(kept.parameters(), start.parameters(), strict=True))
    assert "did not improve" in card_of_run(tmp_path)["limits"][0]


def test_days_without_a_record_of_joint_teach_no_classes_and_are_named_before(data, tmp_path):
    lake = Lake.at(tmp_path / "lake")
    rows = read_rows(Lake.at(data), TRAINING, DAY, TrainingRow)
    write_rows(lake, [replace(row, reference="prior") for row in rows])
    with pytest.raises(ContractError, match="`boresight calibrate`"):
        train(str(tmp_path / "lake"), tmp_path / "run", architecture="matching", steps=1)
    assert "vehicle-1 2026-03-02" in doubts(lake, referenced=True)[0]
    assert "one drive" in doubts(lake, referenced=False)[0]
    write_rows(lake, [replace(row, drive=i) for i, row in enumerate(rows)])
    assert doubts(lake, referenced=True) == []


def test_a_budget_of_time_brings_the_rate_down_whatever_the_speed(data, tmp_path):
    told = []
    result = train(
        data, tmp_path, lambda *done: told.append(done), steps=None, budget_minutes=0.02, log_every=1
    )
    assert result.status == "done"
    assert told[-1][1] <= 2 * result.step  # what is told as the whole run is what fits into the budget
    rates = [r["learning_rate"] for r in reports(tmp_path) if "loss" in r]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.6 * rates[0]


@pytest.mark.slow
def test_sigterm_ends_the_command_with_143_and_a_whole_checkpoint(data, tmp_path):
    command = [sys.executable, "-m", "jobs.cli", "train", "--data", data, "--out", str(tmp_path / "run")]
    command += ["--config", toml(tmp_path, log_every=1), "--device", "cpu", "--steps", "100000"]
    with started(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 1800
        while time.monotonic() < deadline and process.poll() is None:
            if any(line["step"] for line in read_metrics(tmp_path / "run")):  # beyond the start's validation
                break
            time.sleep(0.2)
        process.terminate()
        out, err = process.communicate(timeout=1800)
    assert process.returncode == 143, err
    summary = json.loads(out.splitlines()[-1])
    assert summary["status"] == "stopped"
    state = load_checkpoint(tmp_path / "run" / "last.pt")
    assert state["step"] == summary["step"] > 0


def test_a_diverging_run_stops_with_its_reason_and_keeps_the_last_good_checkpoint(data, tmp_path):
    settings = {"learning_rate": 1e6, "steps": 200, "gradient_norm": 1e9, "checkpoint_minutes": 1e-6}
    with pytest.raises(DivergedError, match="diverged at step") as caught:
        train(data, tmp_path, **settings)
    assert caught.value.exit_code == 1
    state = load_checkpoint(tmp_path / "last.pt")
    assert state["step"] <= caught.value.step
    assert all(torch.isfinite(v).all() for v in state["network"].values() if v.is_floating_point())


def test_the_guard_knows_no_number_and_growth_but_not_noise():
    guard = DivergenceGuard(10.0)
    for step in range(200):
        guard.check(step, 5.0 + 3.0 * math.sin(step), 1.0)
    with pytest.raises(DivergedError, match="nan"):
        guard.check(200, math.nan, 1.0)
    with pytest.raises(DivergedError, match="norm"):
        guard.check(200, 1.0, math.inf)
    with pytest.raises(DivergedError, match="10 times"):
        for step in range(200, 300):
            guard.check(step, 500.0, 1.0)


@pytest.mark.slow
def test_two_processes_train_one_network(data, tmp_path):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["-m", "jobs.cli", "train", "--data", data, "--out", str(tmp_path / "run"), "--steps", "3"]
    command += ["--config", toml(tmp_path), "--device", "cpu"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    state = load_checkpoint(tmp_path / "run" / "last.pt")
    assert state["step"] == 3
    first, second = (p["stream"] for p in state["processes"])
    assert first["order"] != second["order"]  # other frames
    assert (
        len(reports(tmp_path / "run")) == 3
    )  # one of them writes: the last step's report, and two validations
    with pytest.raises(ConfigError, match="began with 2"):
        run(TrainRequest(data, tmp_path / "run", "cpu"), TrainConfig.model_validate(SMALL | {"steps": 3}))


def test_what_cannot_be_right_is_named(tmp_path):
    path = tmp_path / "train.toml"
    for text, key in (
        ("learning_rat = 1", "learning_rat"),
        ("learning_rate = -1", "learning_rate"),
        ("[loss]\nedge = 1", "loss.edge"),
        ("final_learning_rate = 1", "final_learning_rate"),
        ("cell_deg = 0.5", "cell_deg"),
        ("= 3", "not a TOML file"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=key):
            load_train_config(path, {})
    assert load_train_config(None, {"seed": 3, "steps": None}).seed == 3
    with pytest.raises(ContractError, match="prepare"):
        train(str(tmp_path), tmp_path / "run")
    for text in ("", "m", "-3m", "2x", "0", "inf"):
        with pytest.raises(ConfigError):
            parse_duration(text, "time-limit")
    assert parse_duration("1.5h", "budget") == 5400


def test_checkpoints_are_whole_or_not_there(tmp_path):
    path = tmp_path / "last.pt"
    save_checkpoint(path, {"step": 1, "weights": torch.ones(3)})
    path.with_suffix(".part").write_bytes(b"killed while writing")
    assert load_checkpoint(path)["step"] == 1
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ContractError, match="no checkpoint"):
        load_checkpoint(path)


def test_a_run_may_start_from_anothers_weights_and_then_goes_on_with_its_own(data, tmp_path):
    one = {"architecture": "matching", "steps": 1}
    train(data, tmp_path / "old", **one)
    # So small a rate moves nothing that counts: what was handed over is what is there.
    still = one | {"learning_rate": 1e-9, "final_learning_rate": 1e-9, "seed": 5}
    assert train(data, tmp_path / "new", start=tmp_path / "old", **still).status == "done"
    old, new = network_of_run(tmp_path / "old"), network_of_run(tmp_path / "new", best=False)
    for a, b in zip(old.parameters(), new.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-7)
    # What lies in the folder wins: the run is finished, whatever it might start from.
    assert train(data, tmp_path / "new", start=tmp_path / "gone", **still).samples == 0
    with pytest.raises(ContractError, match="neither"):
        train(data, tmp_path / "x", start=tmp_path / "gone", **still)
    with pytest.raises(ConfigError, match=r"width.*another kind: set width = 4"):
        train(data, tmp_path / "y", start=tmp_path / "old", **one, width=8)
    # What the old network never saw counts nothing at first.
    train(data, tmp_path / "z", start=tmp_path / "old", **still, takes_classes=True)
    first = network_of_run(tmp_path / "z", best=False).core.camera_encoder.down[0][0].weight
    assert torch.allclose(first[:, :4], old.core.camera_encoder.down[0][0].weight, atol=1e-7)
    assert first[:, 4:].abs().max() < 1e-7
    # Classes cannot be taken away again.
    with pytest.raises(ConfigError, match=r"takes_classes.*another kind: set takes_classes = true"):
        train(data, tmp_path / "v", start=tmp_path / "z", **one)
