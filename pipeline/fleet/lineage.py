"""A night as OpenLineage events: a run per stage and vehicle-day, below the night's run. Extra [ops].

The id of a run is derived from the work key, so that the same work is the same run for every executor and
repetition.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID, uuid5

from pipeline.fleet.ledger import outcome_row
from pipeline.fleet.nightly import DayOutcome, Night
from pipeline.fleet.pattern import VehicleDay
from pipeline.results import Outcome
from pipeline.stages import INGEST, STAGES
from pipeline.store.partitions import Lake, Partition
from pipeline.store.remote_logs import LogPath
from schemas.columns import TableSchema
from schemas.versions import CODE_VERSION

if TYPE_CHECKING:
    from openlineage.client.event_v2 import InputDataset, Job, OutputDataset, Run, RunEvent

__all__ = ["NightLineage", "run_id_of"]

# Namespace of Boresight's run ids, a random UUID: ids are names below it (RFC 9562, version 5).
_NAMESPACE = UUID("5b0c7e86-3d1a-5f5e-9a4c-6f1f8c1a7d20")
_PRODUCER = f"https://pypi.org/project/boresight/{CODE_VERSION}"
_STAGES = {stage.name: stage for stage in STAGES}


def run_id_of(stage: str, vehicle: str, day: str, work_key: str) -> str:
    """Run id of a stage on a vehicle-day, from the columns of these names in table `outcomes`."""
    return str(uuid5(_NAMESPACE, f"{stage}/{vehicle}/{day}/{work_key}"))


@dataclass(frozen=True)
class NightLineage:
    """The events of one night."""

    night: Night
    logs: Mapping[Partition, tuple[LogPath, ...]] = field(repr=False)

    @classmethod
    def of(cls, night: Night, days: Sequence[VehicleDay]) -> NightLineage:
        """Lineage of a night with these vehicle-days."""
        return cls(night, {d.partition: d.logs for d in days})

    def begun(self, at: dt.datetime) -> RunEvent:
        """First event of the night's run."""
        from openlineage.client.event_v2 import RunState  # noqa: PLC0415 - an extra

        return self._event(RunState.START, at, self._night_run(), self._job("nightly"))

    def ended(self, at: dt.datetime, state: str) -> RunEvent:
        """Last event of the night's run; `state` is COMPLETE, FAIL, or ABORT if it was stopped."""
        from openlineage.client.event_v2 import RunState  # noqa: PLC0415 - an extra

        return self._event(RunState(state), at, self._night_run(), self._job("nightly"))

    def of_day(self, outcome: DayOutcome) -> Iterator[RunEvent]:
        """Two events for each stage that did work; a stage that is up to date was reported by its run."""
        for result in outcome.results:
            if result.status != "cached" and result.effort.began_at:
                yield from self._of_stage(result)

    def _of_stage(self, result: Outcome) -> Iterator[RunEvent]:
        from openlineage.client.event_v2 import RunState  # noqa: PLC0415 - an extra

        began = dt.datetime.fromisoformat(result.effort.began_at)
        ended = began + dt.timedelta(seconds=result.effort.seconds)
        run, job = self._stage_run(result), self._job(result.stage)
        last = RunState.FAIL if result.status == "failed" else RunState.COMPLETE
        inputs, outputs = list(self._inputs(result)), list(self._outputs(result))
        yield self._event(RunState.START, began, run, job, inputs)
        yield self._event(last, ended, run, job, inputs, outputs)

    def _event(
        self,
        state: object,
        at: dt.datetime,
        run: Run,
        job: Job,
        inputs: Iterable[InputDataset] = (),
        outputs: Iterable[OutputDataset] = (),
    ) -> RunEvent:
        from openlineage.client.event_v2 import RunEvent  # noqa: PLC0415 - an extra

        return RunEvent(
            eventType=state, eventTime=at.isoformat(), run=run, job=job, producer=_PRODUCER,
            inputs=list(inputs), outputs=list(outputs),
        )  # fmt: skip

    def _job(self, name: str) -> Job:
        from openlineage.client.event_v2 import Job  # noqa: PLC0415 - an extra
        from openlineage.client.facet_v2 import job_type_job  # noqa: PLC0415

        kind = job_type_job.JobTypeJobFacet("BATCH", "BORESIGHT", "JOB" if name == "nightly" else "TASK")
        return Job(self._jobs, name, {"jobType": kind})

    @property
    def _jobs(self) -> str:
        return f"boresight/{self.night.fleet.fleet.name}"

    def _night_id(self) -> str:
        days = [f"{p.vehicle} {p.day}" for p in sorted(self.logs)]
        return str(uuid5(_NAMESPACE, "\n".join((str(self.night.lake), self.night.method, *days))))

    def _night_run(self) -> Run:
        from openlineage.client.event_v2 import Run  # noqa: PLC0415 - an extra
        from openlineage.client.facet_v2 import processing_engine_run  # noqa: PLC0415

        engine = processing_engine_run.ProcessingEngineRunFacet(CODE_VERSION, "boresight", CODE_VERSION)
        return Run(self._night_id(), {"processing_engine": engine})

    def _stage_run(self, result: Outcome) -> Run:
        from openlineage.client.event_v2 import Run  # noqa: PLC0415 - an extra
        from openlineage.client.facet_v2 import (  # noqa: PLC0415
            error_message_run,
            nominal_time_run,
            parent_run,
            tags_run,
        )

        day = dt.datetime.fromisoformat(result.day).replace(tzinfo=dt.UTC)
        told = {
            "vehicle": result.vehicle,
            "day": result.day,
            "status": result.status,
            "reason": result.reason,
        }
        tags = [tags_run.TagsRunFacetFields(k, v, "BORESIGHT") for k, v in told.items() if v]
        night = parent_run.Run(self._night_id()), parent_run.Job(self._jobs, "nightly")
        facets = {
            "parent": parent_run.ParentRunFacet(*night),
            "nominalTime": nominal_time_run.NominalTimeRunFacet(
                day.isoformat(), (day + dt.timedelta(days=1)).isoformat()
            ),
            "tags": tags_run.TagsRunFacet(tags),
        }
        if result.status == "failed":
            facets["errorMessage"] = error_message_run.ErrorMessageRunFacet(result.reason, "python")
        # A failure has no work key; this derives one as `outcomes` does.
        row = outcome_row(result, self.night.method)
        return Run(run_id_of(row.stage, row.vehicle, row.day, row.work_key), facets)

    def _inputs(self, result: Outcome) -> Iterator[InputDataset]:
        from openlineage.client.event_v2 import InputDataset  # noqa: PLC0415 - an extra

        partition = Partition(result.vehicle, result.day)
        if result.stage == INGEST.name:
            for log in self.logs.get(partition, ()):
                yield InputDataset(*_named(str(log)))
        for schema in _STAGES[result.stage].reads:
            yield InputDataset(*_place(self.night.lake.absolute(), schema, partition))

    def _outputs(self, result: Outcome) -> Iterator[OutputDataset]:
        from openlineage.client.event_v2 import OutputDataset  # noqa: PLC0415 - an extra
        from openlineage.client.facet_v2 import (  # noqa: PLC0415
            dataset_version_dataset,
            output_statistics_output_dataset,
        )

        if not result.outputs:
            return
        count = output_statistics_output_dataset.OutputStatisticsOutputDatasetFacet(result.rows)
        version = dataset_version_dataset.DatasetVersionDatasetFacet(result.work_key)
        for schema in _STAGES[result.stage].writes:
            place = _place(self.night.lake.absolute(), schema, Partition(result.vehicle, result.day))
            yield OutputDataset(*place, {"outputStatistics": count}, facets={"version": version})


def _place(lake: Lake, schema: TableSchema, partition: Partition) -> tuple[str, str]:
    """Namespace and name of a dataset for OpenLineage: one day of a heavy table, or a whole record table."""
    of_day = lake.files.uri(lake.folder(schema.name, partition))
    return _named(lake.table(schema.name) if schema.is_record_table else of_day)


def _named(where: str) -> tuple[str, str]:
    """Namespace and name of a local path or of a bucket object."""
    scheme, separator, rest = where.partition("://")
    if not separator:
        return "file", str(Path(where).absolute())
    bucket, _, name = rest.partition("/")
    return f"{scheme}://{bucket}", name
