"""OpenLineage events of a night, sent to a file and to a real server, and read back by the library's own classes."""

import datetime as dt
import json
import threading
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from uuid import UUID

import pytest

from pipeline.config import FleetConfig
from pipeline.fleet.nightly import Night
from pipeline.fleet.pattern import VehicleDay
from pipeline.store.partitions import Lake, Partition
from pipeline.store.remote_logs import RemoteLog
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.night_outcomes import DAY, day_outcome, stage_outcome

pytest.importorskip("openlineage.client", reason="pip install 'boresight[ops]'")
from openlineage.client import event_v2, facet_v2

from pipeline.fleet.lineage import NightLineage, run_id_of
from pipeline.fleet.lineage_sink import LineageSink

NOW = dt.datetime(2026, 3, 3, 2, tzinfo=dt.UTC)
FACETS = {
    "parent": facet_v2.parent_run.ParentRunFacet,
    "nominalTime": facet_v2.nominal_time_run.NominalTimeRunFacet,
    "tags": facet_v2.tags_run.TagsRunFacet,
    "errorMessage": facet_v2.error_message_run.ErrorMessageRunFacet,
    "processing_engine": facet_v2.processing_engine_run.ProcessingEngineRunFacet,
    "jobType": facet_v2.job_type_job.JobTypeJobFacet,
    "outputStatistics": facet_v2.output_statistics_output_dataset.OutputStatisticsOutputDatasetFacet,
    "version": facet_v2.dataset_version_dataset.DatasetVersionDatasetFacet,
}


@pytest.fixture
def lineage(tmp_path):
    fleet = FleetConfig.model_validate({"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}})
    days = [VehicleDay(Partition("car", DAY), (Path("/logs/a.mcap"),))]
    return NightLineage.of(Night(fleet, Lake.at(tmp_path / "lake")), days)


def good_day():
    made = {"rows": 7, "outputs": ["somewhere"]}
    return day_outcome(
        "car", results=[stage_outcome(s, "car", **made) for s in ("ingest", "perceive", "calibrate")]
    )


def checked(events):
    """The events as JSON; the library's own classes take each of them and each of its facets."""
    for event in events:
        assert event["schemaURL"].startswith("https://openlineage.io/spec/2-")
        run = event_v2.Run(event["run"]["runId"], {})
        job = event_v2.Job(event["job"]["namespace"], event["job"]["name"])
        event_v2.RunEvent(
            eventType=event_v2.RunState(event["eventType"]), eventTime=event["eventTime"], run=run, job=job,
            producer=event["producer"],
        )  # fmt: skip
        datasets = [*event["inputs"], *event["outputs"]]
        held = [event["run"]["facets"], event["job"]["facets"]]
        held += [d.get(k) or {} for d in datasets for k in ("facets", "inputFacets", "outputFacets")]
        for name, facet in (item for facets in held for item in facets.items()):
            own = {k: v for k, v in facet.items() if not k.startswith("_")}
            kind = FACETS[name]
            assert facet["_schemaURL"].split("#")[0] == kind._get_schema().split("#")[0]
            made = {k: v for k, v in own.items() if v is not None}
            kind(**made)
    return events


class Marquez:
    """A server that takes OpenLineage, and answers as it is told to."""

    def __init__(self):
        self.events, self.statuses, self.paths, self.authorised = [], [], set(), set()


@contextmanager
def serving():
    marquez = Marquez()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            status = marquez.statuses.pop(0) if marquez.statuses else 201
            if status == 201:
                marquez.events.append(json.loads(body))
            marquez.paths.add(self.path)
            marquez.authorised.add(self.headers.get("Authorization"))
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_):
            """Nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield marquez, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def send(target, *events, timeout_s=30.0):
    sink = LineageSink(target)
    for event in events:
        sink.emit(event)
    return sink.close(timeout_s)


def test_a_server_gets_a_run_per_stage_below_the_nights(lineage, tmp_path, monkeypatch):
    monkeypatch.setenv("OPENLINEAGE_API_KEY", "secret")
    events = [lineage.begun(NOW), *lineage.of_day(good_day()), lineage.ended(NOW, "COMPLETE")]
    with serving() as (marquez, url):
        marquez.statuses = [201, 503]  # once: the second event is sent again
        assert send(url, *events) == ""
    found = checked(marquez.events)
    assert [(e["job"]["name"], e["eventType"]) for e in found] == [
        ("nightly", "START"),
        *((stage, state) for stage in ("ingest", "perceive", "calibrate") for state in ("START", "COMPLETE")),
        ("nightly", "COMPLETE"),
    ]
    assert marquez.paths == {"/api/v1/lineage"}
    assert marquez.authorised == {"Bearer secret"}
    night, ingest, perceive, calibrate = (found[i] for i in (0, 2, 4, 6))
    assert ingest["run"]["runId"] == run_id_of("ingest", "car", DAY, "key of ingest")
    assert ingest["run"]["facets"]["parent"]["run"]["runId"] == night["run"]["runId"]
    assert [(d["namespace"], d["name"]) for d in ingest["inputs"]] == [("file", "/logs/a.mcap")]
    tables = [f"{tmp_path}/lake/{t}/vehicle=car/day={DAY}" for t in ("moments", "images", "sweeps", "scans")]
    assert [(d["namespace"], d["name"]) for d in ingest["outputs"]] == [("file", table) for table in tables]
    made = ingest["outputs"][0]
    assert made["outputFacets"]["outputStatistics"]["rowCount"] == 7
    assert made["facets"]["version"]["datasetVersion"] == "key of ingest"
    assert [d["name"] for d in perceive["inputs"]] == tables
    records = [f"{tmp_path}/lake/{t}" for t in ("calibrations", "poses")]
    assert [d["name"] for d in calibrate["outputs"]] == records
    assert ingest["eventTime"] == "2026-03-03T01:00:02+00:00"


def test_the_same_work_is_the_same_run_and_other_work_another(lineage):
    ids = [[e.run.runId for e in lineage.of_day(good_day())] for _ in range(2)]
    assert ids[0] == ids[1]
    assert len(set(ids[0])) == 3
    assert all(UUID(i).version == 5 for i in ids[0])
    assert lineage.begun(NOW).run.runId == lineage.ended(NOW, "ABORT").run.runId
    assert run_id_of("ingest", "car", DAY, "a") != run_id_of("ingest", "bus", DAY, "a")


def test_what_lies_in_a_bucket_is_named_after_it(lineage):
    night = replace(lineage.night, lake=Lake.at("s3://fleet/lake"))
    logs = {Partition("car", DAY): (RemoteLog("logs-of-cars", "car/a.mcap"),)}
    _, ended = list(NightLineage(night, logs).of_day(good_day()))[:2]
    assert [(d.namespace, d.name) for d in ended.inputs] == [("s3://logs-of-cars", "car/a.mcap")]
    made = ended.outputs[0]
    assert (made.namespace, made.name) == ("s3://fleet", f"lake/moments/vehicle=car/day={DAY}")


def test_what_was_up_to_date_is_not_told_again(lineage):
    assert (
        list(lineage.of_day(day_outcome("car", "cached", results=[stage_outcome("ingest", "car", "cached")])))
        == []
    )


@pytest.mark.parametrize(("status", "state"), [("failed", "FAIL"), ("refused", "COMPLETE")])
def test_a_failure_says_why_and_a_refusal_is_an_answer(status, state, lineage, tmp_path):
    bad = day_outcome(
        "car", status, results=[stage_outcome("ingest", "car", status, reason="a.mcap is empty")]
    )
    assert send(str(tmp_path / "events.json"), *lineage.of_day(bad)) == ""
    begun, ended = checked([json.loads(line) for line in (tmp_path / "events.json").read_text().splitlines()])
    assert begun["run"]["runId"] == ended["run"]["runId"]
    assert (ended["eventType"], ended["outputs"]) == (state, [])
    tags = {t["key"]: t["value"] for t in ended["run"]["facets"]["tags"]["tags"]}
    assert tags == {"vehicle": "car", "day": DAY, "status": status, "reason": "a.mcap is empty"}
    assert ("errorMessage" in ended["run"]["facets"]) == (status == "failed")


def test_a_server_that_is_down_is_named_and_left_alone(lineage):
    with serving() as (marquez, url):
        marquez.statuses = [400] * 9
        said = send(url, *[lineage.begun(NOW)] * 9)
    assert said.startswith("9 events were not sent: ")
    assert "400" in said
    assert len(marquez.statuses) == 6  # three in a row, and no more


def test_a_server_that_does_not_answer_delays_nobody(lineage):
    held = threading.Event()
    sink = LineageSink("http://127.0.0.1:9")
    sink._transport = type("Slow", (), {"emit": lambda *_: held.wait(20)})()
    for _ in range(3):
        sink.emit(lineage.begun(NOW))
    assert "too slow" in sink.close(0.2)
    held.set()


def test_a_file_that_cannot_be_written_is_named(lineage, tmp_path):
    assert "missing" in send(str(tmp_path / "missing" / "events.json"), lineage.begun(NOW))
