"""Airflow (3.x) DAG: one night, with retries where they may help.

The command is that of an environment of its own: Airflow's pins and Boresight's need not agree. Settings come from the
environment of the workers, as in systemd/night.env.
"""

from __future__ import annotations

import os
import subprocess
from datetime import UTC, datetime, timedelta

from airflow.sdk import dag, task
from airflow.sdk.exceptions import AirflowException, AirflowFailException

LOOK_BACK_DAYS = 7  # logs come late; what is up to date costs milliseconds


@dag(
    dag_id="boresight_night",
    schedule="30 1 * * *",
    start_date=datetime(2026, 1, 1, tzinfo=UTC),
    catchup=False,
    max_active_runs=1,
    tags=["calibration"],
)
def boresight_night() -> None:
    """Recalibrate the fleet from the last days' logs."""

    @task(retries=2, retry_delay=timedelta(minutes=15), execution_timeout=timedelta(hours=10))
    def night() -> str:
        """Returns the night's summary, one line of JSON. A held or refused day is no failure."""
        first = (datetime.now(UTC) - timedelta(days=LOOK_BACK_DAYS)).date().isoformat()
        command = [os.environ.get("BORESIGHT", "boresight"), "nightly", "--from", first]
        for option in ("fleet", "lake", "logs"):
            command += [f"--{option}", os.environ[f"BORESIGHT_{option.upper()}"]]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                told, _ = process.communicate()
            except BaseException:  # Airflow stops the task: so does the night, with nothing half-written
                process.terminate()
                raise
        summary = told.splitlines()[-1] if told else ""
        if process.returncode == 2:
            raise AirflowFailException(f"wrong configuration, another try changes nothing: {summary}")
        if process.returncode not in (0, 3):
            raise AirflowException(f"exit code {process.returncode}: {summary}")
        return summary

    night()


boresight_night()
