"""A radar whose own software turns its points: what its scans, its messages, the truth and fleet.toml say then."""

import json

import numpy as np
import pytest

from pipeline.config import load_fleet
from pipeline.errors import ConfigError
from pipeline.geometry.se3 import log_so3
from pipeline.rig.topics import TOPICS, topics_of
from pipeline.simulate.faults import parse_faults
from pipeline.simulate.fleet import FleetSpec, simulate_fleet
from pipeline.simulate.sensors.rigs import rig_named

SMALL = {"vehicles": 1, "days": 1, "frames": 4, "drives": 1, "environments": "urban"}
STATUS = topics_of("radar", "radar")["alignment"]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Folder by fault."""
    found = {}
    for fault in ("", "realign:0.3@0.5", "realign-untold:0.3"):
        out = tmp_path_factory.mktemp("realign")
        faults = parse_faults(f"vehicle-1:0:radar:{fault}", ["2026-03-02"]) if fault else ()
        simulate_fleet(FleetSpec(**SMALL, faults=faults), out)
        found[fault.partition(":")[0]] = out
    return found


def scans(messages):
    clouds = [m for topic, _, m in messages if topic == TOPICS["radar"]]
    dtype = [("xyz", "<f4", 3), ("doppler", "<f4"), ("power", "<f4")]
    return [np.frombuffer(m.data.tobytes(), dtype) for m in clouds]


@pytest.mark.parametrize(("fault", "since"), [("realign", 2), ("realign-untold", 0)])
def test_points_turn_to_the_left_and_nothing_else_of_the_log_does(simulated, read, the_log, fault, since):
    before, after = (read(the_log(simulated[name])) for name in ("", fault))
    for k, (one, other) in enumerate(zip(scans(before), scans(after), strict=True)):
        turned = np.degrees(
            np.arctan2(other["xyz"][:, 1], other["xyz"][:, 0]) - np.arctan2(*one["xyz"].T[1::-1])
        )
        np.testing.assert_allclose((turned + 180) % 360 - 180, 0.3 if k >= since else 0.0, atol=1e-3)
        np.testing.assert_array_equal(one["doppler"], other["doppler"])
    same = [m for m in after if m[0] not in (STATUS, TOPICS["radar"])]
    assert [m[:2] for m in same] == [m[:2] for m in before if m[0] != TOPICS["radar"]]


@pytest.mark.parametrize(
    ("fault", "stated_deg"), [("realign", [0, 0, 0.3, 0.3]), ("realign-untold", [0] * 4)]
)
def test_the_radar_states_what_it_is_told_to_state(simulated, read, the_log, fault, stated_deg):
    packets = [
        m.location_attributes_packet.misalignment
        for t, _, m in read(the_log(simulated[fault]))
        if t == STATUS
    ]
    assert np.degrees([p.theta for p in packets]) == pytest.approx(stated_deg, abs=0.05)
    assert np.degrees(np.sqrt([p.theta_variance for p in packets])) == pytest.approx([0.05] * 4, rel=1e-4)


def test_a_fleet_without_such_a_fault_has_no_such_messages(simulated, read, the_log):
    assert STATUS not in {topic for topic, _, _ in read(the_log(simulated[""]))}
    rigs = {
        name: load_fleet(out / "fleet.toml").rigs["demo"].radars["radar"] for name, out in simulated.items()
    }
    assert {n: r.alignment for n, r in rigs.items()} == {
        "": (),
        "realign": (STATUS,),
        "realign-untold": (STATUS,),
    }


def test_the_truth_is_of_the_axes_that_points_are_given_in(simulated):
    before, after = (
        np.array(json.loads((simulated[n] / "truth/vehicle-1/2026-03-02.json").read_text())["T_lidar_radar"])
        for n in ("", "realign-untold")
    )
    seems_turned = log_so3(before[:3, :3].T @ after[:3, :3])
    assert np.degrees(seems_turned) == pytest.approx([0, 0, -0.3], abs=1e-6)
    np.testing.assert_allclose(before[:3, 3], after[:3, 3], atol=1e-12)


def test_only_radars_align_themselves():
    with pytest.raises(ConfigError, match="realign happens to radar, not to 'lidar'"):
        parse_faults("vehicle-1:0:lidar:realign:0.3", ["2026-03-02"])
    assert parse_faults("vehicle-1:0:corner_fl:realign:0.3", ["2026-03-02"], rig_named("van"))
    assert topics_of("corner_fl", "radar")["alignment"] == "/radar/corner_fl/location_attributes"
