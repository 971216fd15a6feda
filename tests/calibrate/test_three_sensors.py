import pytest

from pipeline.calibrate.stage import three_sensors
from pipeline.core.config import FleetConfig
from pipeline.core.errors import SolveError
from pipeline.rig.overlap import overlaps_of
from tests.rig.test_overlap import VAN, rig


def config(sensors=VAN, **keys):
    values = {"cameras": {}, "lidars": {}, "radars": {}} | keys
    for name, kind, *_ in sensors:
        topics = (
            {"image": f"/{name}", "info": f"/{name}/info"} if kind == "camera" else {"points": f"/{name}"}
        )
        values[f"{kind}s"][name] = topics
    return FleetConfig.model_validate({"fleet": {"name": "f"}, "rigs": {"van": values}}).rigs["van"]


def names(method, rig, overlaps):
    return {s.kind: s.name for s in three_sensors(method, rig, overlaps)}


def test_the_three_that_share_most_are_taken_unless_the_rig_names_others():
    overlaps = overlaps_of(*rig())
    assert names("tracking", config(), overlaps) == {
        "camera": "front",
        "lidar": "top",
        "radar": "ahead",
    }
    named = config(three=["left", "top", "fl"])
    assert names("tracking", named, overlaps) == {"camera": "left", "lidar": "top", "radar": "fl"}


def test_three_that_share_nothing_are_refused_in_one_sentence():
    with pytest.raises(
        SolveError,
        match=r"^method tracking works on .*: left, top and rr share none, name others as three of the rig$",
    ):
        three_sensors("tracking", config(three=["left", "top", "rr"]), overlaps_of(*rig()))
    blind = [s for s in VAN if s[1] != "camera"]
    with pytest.raises(SolveError, match="no three of the rig do"):
        three_sensors("tracking", config(blind), overlaps_of(*rig(blind)))


def test_a_rig_with_one_of_each_is_asked_nothing():
    few = [s for s in VAN if s[0] in ("front", "top")]
    assert names("tracking", config(few), []) == {"camera": "front", "lidar": "top"}
