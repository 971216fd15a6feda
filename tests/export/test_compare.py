"""Two calibrations side by side: changes as a mechanic would measure them, sigmas that mean what they say."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.export.calibration import ExportedPair
from pipeline.export.compare import Side, compare, composed
from pipeline.report.comparison import comparison_page
from pipeline.rig.graph import EDGE_OF_PAIR
from pipeline.rig.se3 import exp_se3, exp_so3
from pipeline.rig.targets import PairDifference
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.makers.calibrations import T_CAMERA_LIDAR, T_LIDAR_RADAR
from tests.makers.commands import command

VARYING = np.diag([1e-3, 2e-3, 5e-4, 0.01, 0.02, 0.03]) ** 2
COMMON = np.diag([5e-4, 4e-3, 1e-4, 0.02, 0.01, 0.05]) ** 2


def side(title, T, covariance=None, vehicle="v", days=("2026-03-01",), **values):
    pair = ExportedPair(EDGE_OF_PAIR["camera_lidar"], T, covariance, **values)
    return Side(title, {"camera_lidar": pair}, vehicle, frozenset(days))


def test_a_turn_and_a_shift_are_told_apart_whatever_the_lever_arm():
    turned = T_CAMERA_LIDAR.copy()
    turned[:3, :3] = exp_so3(np.array([0, 0.01, 0])) @ T_CAMERA_LIDAR[:3, :3]
    turned[:3, 3] += [0.02, 0, 0]
    [found], notes = compare(side("a", T_CAMERA_LIDAR), side("b", turned, vehicle="w"))
    np.testing.assert_allclose(found.change, [0, 0.01, 0, 0.02, 0, 0], atol=1e-12)
    assert found.sigma is None
    assert found.z is None
    # A camera that turned about its own y axis moves every target by that in azimuth.
    [alone], _ = compare(
        side("a", T_CAMERA_LIDAR), side("b", exp_se3(np.array([0, 0.01, 0, 0, 0, 0])) @ T_CAMERA_LIDAR)
    )
    np.testing.assert_allclose(alone.targets_rad, [0.01, 0], atol=1e-3)
    assert alone.targets_rad[0] == pytest.approx(0.01, rel=1e-6)
    assert any("Two vehicles" in words for words in notes)


@pytest.mark.parametrize("shared", [True, False])
def test_the_change_between_days_is_as_large_as_its_sigma_says(shared):
    """Days whose errors are in part the same every day (one vehicle), or not (two): z has unit spread either way."""
    rng, pairs = np.random.default_rng(11), 150
    T = exp_se3(rng.normal(size=6))
    varying, common = (rng.normal(size=(pairs, 2, 6)) * np.sqrt(np.diag(C)) for C in (VARYING, COMMON))
    z = []
    for own, same in zip(varying, common, strict=True):
        errors = own + (same[0] if shared else same)
        sides = [
            side(day, exp_se3(error) @ T, VARYING + COMMON, "v" if shared else day, (day,), common=COMMON)
            for day, error in zip(("2026-03-01", "2026-03-02"), errors, strict=True)
        ]
        [found], _ = compare(*sides)
        z.append(found.z)
    np.testing.assert_allclose(np.std(z, axis=0), 1, atol=4 / np.sqrt(2 * pairs))  # four sigmas of a spread


def test_days_in_common_are_said_and_nothing_is_taken_out_of_their_sigmas():
    one = side("a", T_CAMERA_LIDAR, VARYING + COMMON, common=COMMON)
    [found], notes = compare(one, side("b", T_CAMERA_LIDAR, VARYING + COMMON, common=COMMON))
    apart, _ = compare(one, side("b", T_CAMERA_LIDAR, VARYING + COMMON, days=("2026-03-05",), common=COMMON))
    assert any("not independent" in words for words in notes)
    assert np.all(found.sigma > apart[0].sigma)


def test_a_file_of_two_pairs_has_the_third_by_composition():
    T = {"camera_lidar": T_CAMERA_LIDAR, "lidar_radar": T_LIDAR_RADAR}
    pairs = {pair: ExportedPair(EDGE_OF_PAIR[pair], own) for pair, own in T.items()}
    T = [[-1, 0, 0, -0.25], [0, 0, -1, 1.5], [0, -1, 0, 1], [0, 0, 0, 1]]  # worked out in the head
    np.testing.assert_array_equal(composed(pairs)["camera_radar"].T, T)


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lake")
    knock = {"radar": np.array([0, 0, np.radians(1.5), 0, 0, 0])}
    records = [
        *vehicle_records("v", 3, np.random.default_rng(1), motion=lambda d: knock if d == 2 else {}),
        *vehicle_records("w", 1, np.random.default_rng(2), status=lambda _: "held"),
    ]
    other = [replace(r, method="tracking", work_key="t") for r in records if r.vehicle == "v"][:3]
    commit_records(Lake.at(folder), CALIBRATIONS, records + other)
    return folder


def test_a_knock_between_two_days_stands_out_in_json_table_and_page(lake, tmp_path, capsys):
    call = ["compare", "2026-03-01", "2026-03-03", "--lake", lake, "--vehicle", "v"]
    told = command(capsys, *call, "--json")
    assert told.code == 0
    found = json.loads(told.out)["pairs"]
    by_pair = {p["pair"]: {row["dof"]: row for row in p["axes"]} for p in found}
    yaw = by_pair["lidar_radar"]["rz"]
    assert yaw["change"] == pytest.approx(np.radians(1.5), abs=4 * yaw["sigma"])
    assert yaw["z"] > 10
    assert max(abs(row["z"]) for row in by_pair["camera_lidar"].values()) < 4
    told = command(capsys, *call, "--page", tmp_path / "page.html")
    assert " yaw " in told.out
    assert told.summary["largest_z"] > 10
    page = (tmp_path / "page.html").read_text()
    for words in ("Further apart than the sigmas explain", "lidar-radar yaw"):
        assert words in page
    assert 0 < page.count('class="n off"') < 6  # what stands out is marked, and nothing else


def test_an_export_is_its_record_and_every_kind_of_source_can_be_named(lake, tmp_path, capsys):
    of_v, urdf = ["--lake", lake, "--vehicle", "v"], tmp_path / "o.urdf"
    command(capsys, "export", "urdf", *of_v, "--day", "2026-03-01", "--out", urdf)
    command(capsys, "import", "urdf", urdf, "--out", tmp_path / "prior.json")
    for other in (f"urdf:{urdf}", tmp_path / "prior.json"):
        told = command(capsys, "compare", "2026-03-01", other, *of_v, "--json")
        changes = [row["change"] for p in json.loads(told.out)["pairs"] for row in p["axes"]]
        assert (told.code, len(changes)) == (0, 18)
        assert np.abs(changes).max() < 1e-12
    # A prior rests on no day.
    for other, same in (("2026-03-01/prior", False), ("2026-03-01/tracking", True), ("w@2026-03-01", False)):
        told = command(capsys, "compare", "v@2026-03-01", other, *of_v, "--json")
        found = json.loads(told.out)
        assert (told.code, len(found["pairs"])) == (0, 3)
        assert any("same days" in note for note in found["notes"]) == same
        assert any("depends on its prior" in note for note in found["notes"]) == other.endswith("/prior")
    assert {p["status_b"] for p in found["pairs"]} == {"held"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["2026-03-01", "x.json"], "needs --lake and --vehicle"),
        (["kitti:none.txt", "kitti:none.txt"], "none.txt: cannot be read"),
        (["none.json", "none.json"], "none.json: no readable JSON"),
        (["v@2026-03-01", "v@today", "--lake", "{lake}"], "is not a day"),
        (["v@state", "v@2026-03-01", "--lake", "{lake}"], "no state of v"),
    ],
)
def test_what_cannot_be_compared_is_a_usage_error(lake, capsys, arguments, words):
    told = command(capsys, "compare", *(a.replace("{lake}", str(lake)) for a in arguments))
    assert told.code == 2
    assert words in told.summary["reason"]


def test_the_page_escapes_names_and_says_when_nobody_states_a_sigma():
    view = PairDifference(
        EDGE_OF_PAIR["camera_lidar"], ("given", "given"), np.zeros(6), None, np.ones(6, bool), np.zeros(2)
    )
    page = comparison_page("<b>a</b>", "b & c", [view], ["a < b"])
    assert "<b>a</b>" not in page
    assert "neither side has a sigma" in page
