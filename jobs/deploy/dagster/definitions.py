"""Dagster definitions: the records of a day as a partitioned asset, made every night.

The command is that of an environment of its own: Dagster's pins and Boresight's need not agree. Settings come from the
environment, as in systemd/night.env.
"""

import json
import os
import subprocess
from datetime import timedelta

import dagster as dg

DAYS = dg.DailyPartitionsDefinition(start_date=os.environ.get("BORESIGHT_FIRST_DAY", "2026-01-01"))


@dg.asset(
    partitions_def=DAYS,
    backfill_policy=dg.BackfillPolicy.single_run(),  # one night over all days that are asked for
    group_name="boresight",
    op_tags={"dagster/max_runtime": int(timedelta(hours=10).total_seconds())},
)
def calibrations(context: dg.AssetExecutionContext) -> dg.MaterializeResult:
    """Calibration records of every vehicle that drove. A held or refused day is no failure."""
    days = context.partition_keys
    command = [os.environ.get("BORESIGHT", "boresight"), "nightly", "--from", min(days), "--to", max(days)]
    for option in ("fleet", "lake", "logs"):
        command += [f"--{option}", os.environ[f"BORESIGHT_{option.upper()}"]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            told, _ = process.communicate()
        except BaseException:  # the run is terminated: so is the night, with nothing half-written
            process.terminate()
            raise
    last = told.splitlines()[-1] if told else "{}"
    if process.returncode == 2:
        raise dg.Failure(f"wrong configuration, another try changes nothing: {last}", allow_retries=False)
    if process.returncode not in (0, 3):
        raise dg.RetryRequested(max_retries=2, seconds_to_wait=900) from dg.Failure(last)
    summary = json.loads(last)
    counts = {k: v for k, v in summary.items() if isinstance(v, int)}
    return dg.MaterializeResult(
        metadata=counts | {"report": dg.MetadataValue.path(summary.get("report") or "")}
    )


night = dg.define_asset_job("boresight_night", selection=[calibrations])
definitions = dg.Definitions(
    assets=[calibrations],
    jobs=[night],
    schedules=[dg.build_schedule_from_partitioned_job(night, hour_of_day=1, minute_of_hour=30)],
)
