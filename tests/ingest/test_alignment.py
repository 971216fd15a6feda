"""A day's messages of a radar about its own alignment, from logs to the manifest."""

import numpy as np
import pytest

from pipeline.config import load_fleet
from pipeline.ingest.alignment import level_and_step
from pipeline.ingest.check import check_logs
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested
from schemas.moments import RADAR_ALIGNMENT
from tests.makers import alignment_messages as of
from tests.makers.written_logs import PERIOD_NS, RADAR, START_NS, fleet_config

STATUS = "/radar/location_attributes"


def fleet(**radar):
    found = fleet_config()
    rig = found.rigs["default"]
    topics = rig.radars["radar"].model_copy(update=radar)
    return found.model_copy(
        update={"rigs": {"default": rig.model_copy(update={"radars": {"radar": topics}})}}
    )


def drive(ros=2, *, theta_rad=(0.005,) * 20, kind=of.BOSCH, field="theta"):
    kit = of.kit_of(ros)
    kit.drive()
    for i, theta in enumerate(theta_rad):
        stamp = START_NS + i * PERIOD_NS // 5
        kit.add(STATUS, kind, stamp, of.message(kit, kind, stamp, **{field: theta}))
    return kit


def stated(tmp_path):
    manifest = ingested(Lake.at(tmp_path / "lake"), Partition("car", "2023-11-14"))
    return manifest.extra.get(RADAR_ALIGNMENT, {})


@pytest.mark.parametrize("container", ["mcap", "bag", "folder"])
def test_the_day_states_what_the_radar_does(run_ingest, tmp_path, container):
    log = getattr(drive(1 if container == "bag" else 2), container)(tmp_path / f"a.{container}")
    result, frames = run_ingest(log, fleet=fleet(alignment=(STATUS,)))
    assert (result.rejected.get("alignment_unusable", 0), len(frames)) == (0, 4)
    found = stated(tmp_path)["radar"]
    assert found["azimuth_rad"] == pytest.approx(0.005, rel=1e-5)
    assert (found["messages"], found["without_angle"], found["azimuth_step_rad"]) == (20, 0, None)
    assert found["last_stamp_ns"] - found["first_stamp_ns"] == 19 * PERIOD_NS // 5


def test_a_step_within_the_day_is_dated(run_ingest, tmp_path):
    rng = np.random.default_rng(5)
    theta = np.where(np.arange(40) < 24, 0.001, 0.001 + np.radians(0.3)) + rng.normal(0, 2e-4, 40)
    run_ingest(drive(theta_rad=theta).mcap(tmp_path / "a.mcap"), fleet=fleet(alignment=(STATUS,)))
    found = stated(tmp_path)["radar"]
    assert np.degrees(found["azimuth_step_rad"]) == pytest.approx(0.3, abs=0.02)
    assert found["azimuth_rad"] == pytest.approx(theta[24:].mean(), abs=2e-4)
    assert found["step_stamp_ns"] == START_NS + 24 * PERIOD_NS // 5


def test_messages_that_cannot_be_read_are_named_and_cost_no_moment(run_ingest, tmp_path):
    from pipeline.rigs import AlignmentFields

    log = drive().mcap(tmp_path / "a.mcap")
    wrong = fleet(alignment=(STATUS,), alignment_fields=AlignmentFields(azimuth="theta"))
    result, frames = run_ingest(log, fleet=wrong)
    assert (result.rejected["alignment_unusable"], len(frames)) == (20, 4)
    assert f"a.mcap: topic {STATUS}, field theta" in result.reason
    assert stated(tmp_path) == {}


def test_check_finds_topics_that_no_radar_names(tmp_path):
    log = drive().mcap(tmp_path / "a.mcap")
    found = fleet_config()
    report = check_logs([log], found.rigs["default"], found)
    assert [a for a in report.advice if STATUS in a and "alignment" in a]
    named = fleet(alignment=(STATUS,))
    report = check_logs([log], named.rigs["default"], named)
    assert not [a for a in report.advice if STATUS in a]
    assert report.radar_alignments["radar"]["messages"] == 20
    assert [t.problem for t in report.topics if t.role.startswith("alignment")] == [""]


def test_fleet_toml_names_one_topic_or_several_of_any_radar(tmp_path):
    text = f"""
[fleet]
name = "f"
[rigs.short.lidar]
points = "/l"
[rigs.short.radar]
points = "{RADAR}"
alignment = "/radar/status"
[rigs.long.lidars.top]
points = "/l"
[rigs.long.radars.nose]
points = "{RADAR}"
alignment = ["/radar/esr_status4", "/radar/esr_status6"]
[vehicles.car]
rig = "short"
"""
    (tmp_path / "fleet.toml").write_text(text)
    rigs = load_fleet(tmp_path / "fleet.toml").rigs
    assert rigs["short"].radars["radar"].alignment == ("/radar/status",)
    assert rigs["long"].radars["nose"].alignment == ("/radar/esr_status4", "/radar/esr_status6")


def test_a_radar_without_alignment_is_dumped_as_before():
    assert not {k for k in fleet_config().rigs["default"].radars["radar"].model_dump() if "alignment" in k}


@pytest.mark.parametrize("size_deg", [-0.4, 0.0, 0.3])
def test_a_step_is_found_where_there_is_one(size_deg):
    rng = np.random.default_rng(3)
    values = rng.normal(0, np.radians(0.02), 200) + np.radians(size_deg) * (np.arange(200) >= 130)
    level, scatter, step, place = level_and_step(values)
    assert np.degrees(level) == pytest.approx(size_deg, abs=0.01)
    assert np.degrees(scatter) == pytest.approx(0.02, rel=0.3)
    assert (place, step is None) == ((130, False) if size_deg else (0, True))
    if step is not None:
        assert np.degrees(step) == pytest.approx(size_deg, abs=0.02)
