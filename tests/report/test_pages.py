"""The pages: what they say, and that a real browser shows them without a complaint."""

import json
import re
from dataclasses import replace
from urllib.parse import quote, unquote

import numpy as np
import pytest

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError
from pipeline.report.stage import Pages, write_day_page, write_fleet_report
from pipeline.report.truth import read_truth
from pipeline.rig.se3 import exp_se3
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import T_CAMERA_LIDAR, T_LIDAR_RADAR, vehicle_records
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.fleet_pages import write_fleet_page
from tests.makers.lakes import write_records
from tests.makers.stages import audit_fleet

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])


def _config():
    return FleetConfig.model_validate({"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}})


def _store(lake, records):
    for vehicle, day in sorted({(r.vehicle, r.day) for r in records}):
        rows = [r for r in records if (r.vehicle, r.day) == (vehicle, day)]
        write_records(lake, CALIBRATIONS, rows, rows[0].work_key)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A lake with three vehicles, one of them knocked, its fleet page and truth."""
    root = tmp_path_factory.mktemp("fleet")
    lake, rng = Lake.at(root / "lake"), np.random.default_rng(21)
    for vehicle, motion in (("van <1>", {}), ("b", {"radar": KNOCK}), ("c", {})):
        status = {2: "held", 3: "refused"} if vehicle == "c" else {}
        records = vehicle_records(
            vehicle, 4, rng, motion=lambda d, m=motion: m if d > 1 else {},
            status=lambda d, s=status: s.get(d, "accepted"),
        )  # fmt: skip
        _store(lake, [_with_blind_roll(r) if r.pair == "lidar_radar" else r for r in records])
    audit_fleet(lake, _config())
    truth = root / "truth"
    for vehicle, day in [*(("b", day) for day in range(4)), ("c", 3)]:  # the last one was refused
        path = truth / vehicle / f"2026-03-0{day + 1}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        lr = T_LIDAR_RADAR @ (exp_se3(KNOCK) if day > 1 else np.eye(4))
        T = {"camera": np.eye(4), "lidar": T_CAMERA_LIDAR, "radar": T_CAMERA_LIDAR @ lr}
        path.write_text(json.dumps({"T_base_sensor": {name: value.tolist() for name, value in T.items()}}))
    page = root / "fleet page.html"
    write_fleet_report(lake, _config(), Pages(page, read_truth(truth)))
    return lake, page, truth


def _with_blind_roll(record):
    if record.status == "refused":
        return record
    return replace(
        record, observable=[k not in (0, 5) for k in range(6)], reason="not determined by the day: roll, up"
    )


def test_the_fleet_page_says_first_what_moved_since_when_and_how_sure(fleet):
    text = fleet[1].read_text()
    first = text[text.index("<h1>") :][:900]
    assert "A sensor moved on 1 of 3 vehicles: b: radar since 2026-03-03." in first
    assert "at most 1 in 1000 vehicle-days" in first
    assert re.search(r"yaw \+(0\.9|1\.0)\d* ± 0\.0\d+ deg", text)
    assert "van &lt;1&gt;" in text
    assert "van <1>" not in text


def test_the_fleet_page_links_every_day_page_by_a_relative_path(fleet):
    links = re.findall(r'href="([^"#]+\.html)"', fleet[1].read_text())
    assert len(links) == 12
    for link in links:
        page = fleet[1].parent / unquote(link)
        assert page.is_file()
        back = re.search(r'href="(\.\./\.\./[^"]+)"', page.read_text())
        assert back is not None
        assert (page.parent / unquote(back[1])).resolve() == fleet[1].resolve()


def test_pages_have_no_outside_resources(fleet):
    for page in [fleet[1], *fleet[1].parent.glob("*_days/*/*.html")]:
        text = page.read_text()
        assert not re.search(r'(src|href|url)\s*[=(]\s*["\']?(https?:)?//', text)
        assert '<link rel="stylesheet' not in text
        assert "@import" not in text


def test_the_truth_table_counts_the_axes_within_three_sigmas(fleet):
    found = re.search(r"(\d+) of (\d+) determined axes are within three sigmas", fleet[1].read_text())
    assert found is not None
    assert int(found[2]) == 4 * (6 + 6 + 4)
    assert int(found[1]) >= int(found[2]) - 2


@pytest.mark.parametrize(
    ("vehicle", "day", "answer", "kind"),
    [
        ("b", "2026-03-04", "Yes. All pairs are accepted", "good"),
        ("b", "2026-03-01", "Not any more. The radar moved on 2026-03-03, after this day. Only camera", "bad"),
        ("c", "2026-03-03", "No. Nothing was accepted", "bad"),
        ("c", "2026-03-04", "No. Nothing was accepted", "bad"),
    ],
)  # fmt: skip
def test_a_day_page_answers_first_whether_its_numbers_can_be_trusted(
    fleet, tmp_path, vehicle, day, answer, kind
):
    page = write_day_page(fleet[0], Partition(vehicle, day), _config(), tmp_path / "day.html")
    text = page.read_text()
    body = text[text.index("<h1>") :]
    assert answer in body[:600]
    assert f'class="answer {kind}"' in body
    assert body.index("answer") < body.index("axis by axis") < body.index("Provenance")


def test_a_held_day_after_a_move_says_that_nothing_is_safe(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    knocked = lambda d: {"radar": 3 * KNOCK} if d > 2 else {}  # noqa: E731
    records = vehicle_records("v", 5, np.random.default_rng(5), motion=knocked)
    is_held = lambda r: r.day > "2026-03-03" and "radar" in r.pair  # noqa: E731
    _store(lake, [replace(r, status="held") if is_held(r) else r for r in records])
    audit_fleet(lake, _config())
    text = write_day_page(lake, Partition("v", "2026-03-05"), _config(), tmp_path / "d.html").read_text()
    said = "Only camera-lidar may be used. The radar moved"
    assert said in text


def test_the_copied_json_is_the_record_and_a_page_without_pictures_has_none(fleet, tmp_path):
    page = write_day_page(
        fleet[0], Partition("b", "2026-03-01"), _config(), tmp_path / "d.html", pictures=False
    )
    text = page.read_text()
    [copied] = re.findall(r'id="json-camera_lidar">(.*?)</script>', text, re.DOTALL)
    value = json.loads(copied)
    assert value["parent_frame"] == "camera"
    np.testing.assert_allclose(np.array(value["T"])[:3, 3], [value["tx_m"], value["ty_m"], value["tz_m"]])
    assert np.linalg.norm(np.array(value["T"])[:3, 3] - T_CAMERA_LIDAR[:3, 3]) < 0.1
    assert "without pictures" in text
    assert "data:image" not in text
    assert "Not determined by this day: roll, up." in text
    assert "no highway: radar roll is weak" in text  # a note of the record


def test_a_hostile_name_cannot_leave_its_place(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    records = vehicle_records("</script><b>x", 1, np.random.default_rng(0))
    with pytest.raises(ConfigError):
        Partition("a/b", "2026-03-01")
    with pytest.raises(ConfigError):
        Partition(records[0].vehicle, records[0].day)
    hostile = "</script><script>alert(1)</script>"
    records = [replace(r, vehicle="v", work_key="k", reason=hostile, notes=[hostile]) for r in records]
    _store(lake, records)
    text = write_day_page(lake, Partition("v", "2026-03-01"), _config(), tmp_path / "d.html").read_text()
    assert "<script>alert" not in text


def test_an_empty_lake_gives_an_honest_fleet_page_and_no_day_page(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    text = write_fleet_page(lake, _config(), tmp_path / "fleet.html")
    assert "No audit yet" in text
    with pytest.raises(ConfigError, match="no joint record"):
        write_day_page(lake, Partition("v", "2026-03-01"), _config(), tmp_path / "d.html")


@pytest.mark.browser
def test_the_browser_check_itself_sees_planted_errors(browser, tmp_path):
    for name, content in {
        "console": "<script>console.error('planted')</script>",
        "exception": "<script>nothing.here()</script>",
        "image": "<img src='missing.png'>",
        "outside": "<img src='http://127.0.0.1:9/x.png'>",
    }.items():
        page = tmp_path / f"{name}.html"
        page.write_text(f"<!doctype html><title>x</title>{content}")
        assert browser.open(page), name


@pytest.mark.browser
@pytest.mark.parametrize("dark", [False, True])
def test_pages_open_without_a_complaint_and_fit_a_laptop(browser, fleet, tmp_path, dark):
    page = write_day_page(fleet[0], Partition("b", "2026-03-04"), _config(), tmp_path / "day.html")
    for path in (fleet[1], page):
        assert browser.open(path, dark=dark) == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= 1366
        assert browser.evaluate("document.querySelector('.answer').getBoundingClientRect().bottom") < 400
        background = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        level = np.mean([int(v) for v in re.findall(r"\d+", background)[:3]])
        assert (level < 60) if dark else (level > 200)
        browser.screenshot(tmp_path / "shot.png")
        assert (tmp_path / "shot.png").stat().st_size > 10_000


@pytest.mark.browser
def test_on_a_phone_the_words_of_the_fleet_have_room_and_a_day_fits(browser, fleet):
    phone = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.call("Emulation.setDeviceMetricsOverride", **phone)
    try:
        assert browser.open(fleet[1]) == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= 390
        widths = "[...document.querySelectorAll('td.words')].map(cell => cell.getBoundingClientRect().width)"
        assert len(found := browser.evaluate(widths)) > 4
        assert min(found) > 280
        day = fleet[1].parent / f"{fleet[1].stem}_days" / "2026-03-04" / "b.html"
        assert browser.open(day) == []
        assert browser.evaluate("document.documentElement.scrollWidth") <= 390
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")


@pytest.mark.browser
@pytest.mark.parametrize("place", ["#vehicles-table", "#charts"])
def test_commands_of_the_next_steps_are_code_that_a_button_copies(browser, fleet, place):
    assert browser.open(fleet[1]) == []
    browser.evaluate(
        "document.addEventListener('copy', () => { window.copied = document.activeElement.value; })"
    )
    code = browser.evaluate(
        f"(window.button = document.querySelector('{place} button.copy')).previousElementSibling.textContent"
    )
    assert code.startswith("boresight ")
    assert "`" not in browser.evaluate(f"document.querySelector('{place}').textContent")
    browser.evaluate("window.button.focus()")
    browser.press("Enter")
    assert browser.evaluate("[window.copied, window.button.textContent]") == [code, "Copied"]


@pytest.mark.browser
def test_a_page_can_be_used_by_keyboard_alone(browser, fleet, tmp_path):
    page = write_day_page(fleet[0], Partition("b", "2026-03-04"), _config(), tmp_path / "day.html")
    assert browser.open(page) == []
    browser.press("Tab")
    assert "Skip" in browser.evaluate("document.activeElement.textContent")
    for _ in range(40):
        browser.press("Tab")
        if browser.evaluate("document.activeElement.dataset.copy"):
            break
    assert browser.evaluate("document.activeElement.dataset.copy") == "json-camera_lidar"
    browser.press("Enter")
    assert browser.evaluate("document.activeElement.textContent") in ("Copied", "Press Ctrl+C")


def test_vehicles_whose_names_look_alike_have_pages_of_their_own(tmp_path):
    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(8)
    for vehicle in ("a b", "a_b", "ä b"):
        _store(lake, vehicle_records(vehicle, 1, rng))
    pages = write_fleet_report(lake, _config(), Pages(tmp_path / "fleet.html"))
    assert len(set(pages)) == len(pages) == 4
    texts = [p.read_text() for p in pages[1:]]
    assert all(any(vehicle in text for text in texts) for vehicle in ("a b", "a_b", "ä b"))
    for page in pages[1:]:
        assert quote(page.name) in (tmp_path / "fleet.html").read_text()
