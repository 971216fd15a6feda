"""`boresight nightly`: metrics and exit codes of a night without work: one day that has not come yet."""

import json

import pytest

from jobs.cli import main
from tests.makers.fleet_files import fleet_toml


@pytest.fixture
def night(tmp_path, capfd):
    log = tmp_path / "logs" / "car" / "2999-03-02" / "a.mcap"
    log.parent.mkdir(parents=True)
    log.touch()
    (tmp_path / "fleet.toml").write_text(fleet_toml("car"))

    def run(*options):
        places = ["--fleet", f"{tmp_path}/fleet.toml", "--lake", f"{tmp_path}/lake"]
        places += ["--logs", f"{tmp_path}/logs/{{vehicle}}/{{day}}/*"]
        code = main(["nightly", *places, "--executor", "inline", *options])
        out, err = capfd.readouterr()
        return code, json.loads(out.splitlines()[-1]), err

    return run


def test_a_refused_day_is_a_success_where_the_scheduler_knows_no_other(night):
    assert night()[0] == 3
    code, summary, _ = night("--held-exit-code", "0")
    assert (code, summary["status"], summary["refused"]) == (0, "refused", 1)
    assert night("--held-exit-code", "1")[0] == 2  # no other can be asked for


def test_a_night_is_told_to_monitoring_and_metrics_that_cannot_be_written_fail_nothing(night, tmp_path):
    pytest.importorskip("prometheus_client", reason="pip install 'boresight[ops]'")
    assert night("--metrics", f"{tmp_path}/night.prom")[0] == 3
    metrics = (tmp_path / "night.prom").read_text()
    assert 'boresight_vehicle_days{fleet="tests",status="refused"} 1.0' in metrics
    assert "boresight_last_success_timestamp_seconds" in metrics
    code, summary, err = night("--metrics", f"{tmp_path}/missing/night.prom")
    assert (code, summary["status"]) == (3, "refused")
    assert f"{tmp_path}/missing/night.prom" in err
