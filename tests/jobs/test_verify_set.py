"""`boresight verify-set`: logs of a set are judged one by one, with known turns, and one bad log stops nothing."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from jobs.cli import main
from pipeline.fleet import executor as executors
from pipeline.stages import CALIBRATE
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.set_checks import SET_CHECKS, SetCheck
from tests.makers.data_sets import more_scenes, nuscenes
from tests.makers.fleet_files import fleet_toml
from tests.makers.simulated_days import simulated_day
from tests.makers.written_logs import Kit

DAY = "2023-11-14"  # of the written logs


@pytest.fixture
def rough_set(tmp_path):
    """A set of short drives: two of a car, one without tf_static, a copy, a damaged file, an unknown vehicle."""
    for vehicle in ("car", "van", "stranger"):
        (tmp_path / "logs" / vehicle / DAY).mkdir(parents=True)
    car, van = (tmp_path / "logs" / name / DAY for name in ("car", "van"))
    Kit(frames=4).drive().mcap(car / "a.mcap")
    (car / "again").mkdir()
    (car / "again" / "a.mcap").write_bytes((car / "a.mcap").read_bytes())
    bare = Kit(frames=4).drive()
    bare.messages = [m for m in bare.messages if m[0] != "/tf_static"]
    bare.mcap(van / "bare.mcap")
    (van / "broken.mcap").write_bytes(b"this is no log")
    Kit(frames=5).drive().mcap(tmp_path / "logs" / "stranger" / DAY / "b.mcap")
    (tmp_path / "fleet.toml").write_text(fleet_toml("car", "van"))
    return tmp_path


def judge(folder, capsys, *more, logs="logs/{vehicle}/{day}/**/*.mcap", executor="inline"):
    command = [
        "verify-set",
        "--fleet",
        f"{folder}/fleet.toml",
        "--logs",
        f"{folder}/{logs}",
        "--out",
        f"{folder}/out",
    ]
    code = main([*command, "--executor", executor, *more])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def rows_of(folder):
    return pq.read_table(folder / "out" / "set_checks.parquet").to_pylist()


def test_logs_that_give_no_answer_are_counted_and_named_and_the_rest_goes_on(rough_set, capsys):
    code, told = judge(rough_set, capsys, "--turns", "2")
    assert (code, told["status"], told["logs"]) == (3, "inconclusive", 4)
    named = {entry["log"].rpartition("/")[2]: entry for entry in told["named"]}
    assert named["broken.mcap"]["answer"] == "unusable"
    assert named["bare.mcap"]["answer"] == "no calibration"
    assert "tf_static" in named["bare.mcap"]["reason"]
    assert (named["b.mcap"]["answer"], "'stranger'" in named["b.mcap"]["reason"]) == ("no rig", True)
    assert [path.rpartition("/")[2] for path in told["copies"]] == ["a.mcap"]
    # Four frames decide nothing, and say why.
    assert told["answers"] == {"undecided": 2}
    page = (rough_set / "out" / "set.html").read_text()
    for word in ("These logs do not decide", "broken.mcap", "same content as another log", "no calibration"):
        assert word in page
    assert {row["answer"] for row in rows_of(rough_set)} == {
        "undecided",
        "unusable",
        "no calibration",
        "no rig",
    }


def test_a_second_run_asks_only_what_is_not_recorded(rough_set, capsys, monkeypatch):
    first = judge(rough_set, capsys, "--turns", "2")[1]
    calibrated = []
    monkeypatch.setattr(type(CALIBRATE), "run", lambda stage, _: calibrated.append(stage.name))
    again = judge(rough_set, capsys, "--turns", "2")[1]
    assert {key: again[key] for key in ("answers", "sensors", "turns")} == {
        key: first[key] for key in ("answers", "sensors", "turns")
    }
    assert calibrated == []
    assert again["named"] == first["named"]


def test_what_was_answered_before_a_stop_is_recorded(rough_set, capsys, monkeypatch):
    Kit(frames=6).drive().mcap(rough_set / "logs" / "car" / DAY / "later.mcap")

    def stopped(*arguments):
        yield next(executors.run_inline(*arguments))
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setitem(executors.EXECUTORS, "inline", stopped)
        assert judge(rough_set, capsys, "--turns", "0")[0] == 130
    kept = read_records(Lake.at(rough_set / "out"), SET_CHECKS, SetCheck)
    assert {row.log.rpartition("/")[2] for row in kept} == {"a.mcap"}
    told = judge(rough_set, capsys, "--turns", "0")[1]
    assert told["logs"] == 5
    again = [row for row in rows_of(rough_set) if row["log"].endswith("/a.mcap")]
    assert {row["recorded_at"] for row in again} == {row.recorded_at for row in kept}


def test_a_log_of_another_rig_costs_only_the_sensor_that_it_lacks(rough_set, capsys):
    other = Kit(frames=6).drive()
    other.messages = [m for m in other.messages if "radar" not in m[0]]
    folder = rough_set / "logs" / "van" / "2023-11-15"
    folder.mkdir()
    other.mcap(folder / "no_radar.mcap")
    told = judge(rough_set, capsys, "--turns", "0", logs="logs/{vehicle}/{day}/no_radar.mcap")[1]
    assert told["named"] == []
    assert {s["sensor"]: s["undecided"] for s in told["sensors"]} == {"camera": 1, "radar": 1}
    [why] = {row["reason"] for row in rows_of(rough_set) if row["sensor"] == "radar"}
    assert "no pose of it" in why or "radar" in why


def test_a_pool_of_processes_gives_the_same_rows(rough_set, capsys):
    judge(rough_set, capsys, "--turns", "1")
    inline = rows_of(rough_set)
    (rough_set / "out").rename(rough_set / "before")
    judge(rough_set, capsys, "--turns", "1", "--workers", "1", executor="process")
    stamps = ("recorded_at", "asserted_at")
    plain = [
        [{k: v for k, v in row.items() if k not in stamps} for row in rows]
        for rows in (inline, rows_of(rough_set))
    ]
    assert plain[0] == plain[1]
    assert set(executors.EXECUTORS) >= {"inline", "process", "ray"}


def test_more_turns_in_a_later_run_go_on_from_what_is_recorded(rough_set, capsys):
    only = "logs/{vehicle}/{day}/a.mcap"
    judge(rough_set, capsys, "--turns", "0", logs=only)
    before = {(r["turn"], r["sensor"], r["axis"]): r["recorded_at"] for r in rows_of(rough_set)}
    assert {turn for turn, _, _ in before} == {""}
    told = judge(rough_set, capsys, "--turns", "2", logs=only)[1]
    after = {(r["turn"], r["sensor"], r["axis"]): r["recorded_at"] for r in rows_of(rough_set)}
    turns = {turn for turn, _, _ in after} - {""}
    assert len(turns) == 2
    assert len({abs(float(turn.split()[2])) for turn in turns}) == 1  # both signs of one size
    assert sum(t["looks"] for t in told["turns"]) == 2


def test_a_claim_counts_only_if_its_file_is_what_it_was_before_the_first_log(rough_set, capsys):
    claims = rough_set / "claims.toml"
    claims.write_text('[[claims]]\ntext = "All is right."\nanswer = "right"\nat_least = 1.0\n')
    only = "logs/{vehicle}/{day}/a.mcap"
    told = judge(rough_set, capsys, "--claims", str(claims), "--turns", "0", logs=only)[1]
    assert told["claims"] == {"refuted": 1}
    claims.write_text('[[claims]]\ntext = "Nothing is wrong."\nanswer = "wrong"\nat_most = 0.0\n')
    code, told = judge(rough_set, capsys, "--claims", str(claims), "--turns", "0", logs=only)
    assert (code, told["claims"]) == (3, {"not counted": 1})
    page = (rough_set / "out" / "set.html").read_text()
    assert "All is right." in page  # what was claimed first stays, with what became of it
    assert "as registered: refuted" in page
    assert "the file changed after the run began" in page
    assert "Nothing is wrong." not in page
    late = rough_set / "late.toml"
    late.write_text('[[claims]]\ntext = "I knew."\nanswer = "undecided"\nat_least = 1.0\n')
    assert judge(rough_set, capsys, "--claims", str(late), "--turns", "0", logs=only)[1]["claims"] == {
        "not counted": 2
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[claims]", "is no TOML"),
        ("", "has no [[claims]]"),
        ('[[claims]]\ntext = "x"\nanswer = "right"\n', "either at_least or at_most"),
        (
            '[[claims]]\ntext = "x"\nanswer = "right"\nat_least = 0.5\ndeg = 1.0\n',
            "deg and axis are of turns",
        ),
        ('[[claims]]\ntext = "x"\nanswer = "good"\nat_least = 0.5\n', "claims.0.answer"),
    ],
)
def test_claims_that_say_nothing_are_refused_before_a_log_is_opened(text, said, rough_set, capsys):
    (rough_set / "claims.toml").write_text(text)
    code, told = judge(rough_set, capsys, "--claims", f"{rough_set}/claims.toml")
    assert code == 2
    assert said in told["reason"]
    assert not (rough_set / "out" / "claims.json").exists()


@pytest.mark.slow
def test_a_true_calibration_is_right_and_a_turned_camera_is_called_wrong(tmp_path, capsys):
    made = simulated_day(tmp_path, frames=30, seed=23)
    truth = {f"T_{pair}": made.truth[pair].tolist() for pair in ("camera_lidar", "lidar_radar")}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    fleet = (tmp_path / "fleet.toml").read_text()
    (tmp_path / "fleet.toml").write_text(
        fleet.replace('source = "tf_static"', 'source = "file"\nfile = "truth.json"')
    )
    told = judge(
        tmp_path, capsys, "--per", "day", "--turns", "10", "--sizes", "2", logs="logs/{vehicle}/{day}/*"
    )[1]
    assert "wrong" not in told["answers"]
    assert told["answers"]["right"] >= 1
    camera = [t for t in told["turns"] if t["sensor"] == "camera" and t["axis"] == "azimuth"]
    assert [(t["deg"], t["wrong"], t["right"]) for t in camera] == [(1.0, 2, 0)]
    turned = [r for r in rows_of(tmp_path) if r["turn"] == "camera azimuth +1" and r["sensor"] == "camera"]
    off = {r["axis"]: np.degrees(r["off_rad"]) for r in turned}
    assert off["azimuth"] == pytest.approx(1.0, abs=0.25)
    assert off["elevation"] < 0.25


def judge_nuscenes(folder, capsys, *more):
    command = ["verify-set", "nuscenes", f"{folder}/data", "--out", f"{folder}/out", "--executor", "inline"]
    code = main([*command, "--turns", "0", *more])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_data_set_is_judged_from_its_own_folder_in_one_command(tmp_path, capsys, monkeypatch):
    (tmp_path / "data").mkdir()
    more_scenes(nuscenes(tmp_path / "data"), 3)
    # Stopped in the middle: what was answered is kept, and nothing else of it.

    def stopped(*arguments):
        results = executors.run_inline(*arguments)
        yield next(results)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setitem(executors.EXECUTORS, "inline", stopped)
        assert judge_nuscenes(tmp_path, capsys)[0] == 130
    kept = read_records(Lake.at(tmp_path / "out"), SET_CHECKS, SetCheck)
    assert len({row.log for row in kept}) == 1
    code, told = judge_nuscenes(tmp_path, capsys)
    assert (code, told["status"], told["logs"]) == (3, "inconclusive", 3)
    rows = rows_of(tmp_path)
    assert {row["log"].rpartition("/")[2] for row in rows if not row["fused"]} == {
        "scene-0001", "scene-0002", "scene-0003",
    }  # fmt: skip
    again = [row for row in rows if row["log"] == kept[0].log]
    assert {row["recorded_at"] for row in again} == {kept[0].recorded_at}
    assert not list(tmp_path.rglob("*.mcap"))
    # Whoever gives no models is told that no camera can be judged.
    assert "without labels no camera" in told["note"]
    assert told["note"] in (tmp_path / "out" / "set.html").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nuscenes"], "a data set and its folder"),
        (["--fleet", "fleet.toml"], "--fleet and --logs"),
        (["nuscenes", "nowhere"], "tables"),
        (["nuscenes", "nowhere", "--segmenter", "s.toml"], "both or neither"),
    ],
)
def test_half_a_command_is_refused_with_what_is_missing(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["verify-set", *words, "--out", "out"]) == 2
    assert said in capsys.readouterr().out
