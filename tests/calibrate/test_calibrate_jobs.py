"""The commands calibrate and evaluate: what they print, what they return."""

import json

import pytest

from jobs.calibrate import calibrate, parse_pair
from jobs.evaluate import evaluate
from jobs.status import status
from pipeline.core.errors import ConfigError
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.words import day_word
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_observations
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

FLEET = fleet_toml(
    "v", sections="[select]\nframes = 12\n[solve]\npaper_population = 12\npaper_generations = 5\n"
)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    (folder / "fleet.toml").write_text(FLEET)
    write_observations(Lake.at(folder / "lake"), Partition("v", "2024-05-06"), make_day(24), "k")
    truth = {"T_camera_lidar": T_CAMERA_LIDAR.tolist(), "T_lidar_radar": T_LIDAR_RADAR.tolist()}
    (folder / "truth" / "v").mkdir(parents=True)
    (folder / "truth" / "v" / "2024-05-06.json").write_text(json.dumps(truth))
    return folder


def run(workplace, day="2024-05-06"):
    return calibrate(
        fleet=workplace / "fleet.toml", lake=str(workplace / "lake"), vehicle="v", day=day,
        method="pairwise-optimisation", perturb="1,0.05", seed=2,
    )  # fmt: skip


def last_line(capsys):
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def test_calibrate_ends_with_one_summary_and_the_code_of_its_verdicts(workplace, capsys):
    code = run(workplace)
    summary = last_line(capsys)
    assert sum(summary["pairs"].values()) == 3
    word = day_word(status for status, count in summary["pairs"].items() if count)
    assert (code, summary["status"]) == (0 if word == "done" else 3, word)
    assert run(workplace) == code
    assert last_line(capsys)["status"] == ("cached" if word == "done" else word)


def test_a_command_by_itself_says_what_became_of_the_day_too(workplace, capsys):
    for _ in range(2):
        run(workplace)
    [row] = read_records(Lake.at(workplace / "lake"), OUTCOMES, OutcomeRow, day="2024-05-06")
    assert (row.stage, row.method, row.status) == ("calibrate", "pairwise-optimisation", "done")
    capsys.readouterr()
    assert status(lake=str(workplace / "lake"), json=True) == 0
    days = {d["day"]: d for d in last_line(capsys)["days"]}
    assert sum(days["2024-05-06"]["pairs"].values()) == 3


def test_a_day_without_observations_is_an_error_and_no_record(workplace):
    with pytest.raises(ConfigError, match="no observations of v on 2024-01-01: run `boresight ingest`"):
        run(workplace, day="2024-01-01")
    assert read_records(Lake.at(workplace / "lake"), OUTCOMES, OutcomeRow, day="2024-01-01") == []
    with pytest.raises(ConfigError, match="unknown vehicle"):
        calibrate(fleet=workplace / "fleet.toml", lake=str(workplace / "lake"), vehicle="w", day="2024-05-06")


def test_evaluate_compares_with_a_folder_or_a_file_of_truth_and_writes_the_table(workplace, capsys):
    run(workplace)
    out = workplace / "table.md"
    assert evaluate(lake=str(workplace / "lake"), truth=workplace / "truth", out=out) == 0
    summary = last_line(capsys)
    assert summary["runs"] == 1
    assert "| pairwise-optimisation | all | 1 |" in out.read_text()
    file = workplace / "truth" / "v" / "2024-05-06.json"
    assert evaluate(lake=str(workplace / "lake"), truth=file) == 0
    capsys.readouterr()
    assert evaluate(lake=str(workplace / "lake"), truth=workplace / "lake") == 3  # records without a truth
    assert last_line(capsys)["runs_without_truth"] >= 1
    with pytest.raises(ConfigError, match="either --truth or --reflectors"):
        evaluate(lake=str(workplace / "lake"))


@pytest.mark.parametrize("text", ["2", "2,0.1,3", "a,b", "-1,0", "200,0", "1,nan"])
def test_perturb_must_be_two_possible_numbers(text):
    with pytest.raises(ConfigError, match="perturb"):
        parse_pair(text, "perturb")
