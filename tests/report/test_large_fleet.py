"""The page of ten thousand vehicles: what it weighs, and that a person finds in it what needs attention."""

import json
import re
import shutil
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.names import is_vehicle
from pipeline.report.charts import fleet_charts
from pipeline.report.fleet_page import render_fleet_page
from pipeline.report.page import page_stem
from pipeline.report.upkeep import Album
from pipeline.report.verdicts import read_verdicts
from pipeline.report.window import read_window
from pipeline.store.commits import commit_records
from pipeline.store.files import LocalFiles
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.service_events import ServiceEvent
from tests.audit.fleet_records import covariance_of, vehicle_records
from tests.makers.stages import audit_fleet
from tests.report.test_pages import _config

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])
# Motion of a sensor from a day on, statuses of days, days that are driven; one of a dozen is knocked.
KINDS = {
    "radar-knocked": ({"radar": KNOCK}, {}, 1),
    "camera-knocked": ({"camera": KNOCK[[1, 2, 0, 3, 4, 5]] / 3}, {}, 1),
    "last-day-alone": ({"radar": KNOCK}, {}, 1),
    "held": ({}, {2: "held", 5: "refused", 6: "held", 9: "held"}, 1),
    "weekly": ({}, {}, 7),
    **{f"good-{k}": ({}, {3: "held"} if k % 3 else {}, 1) for k in range(7)},
}


def some_of_each_kind(lake, fleet, days=28, seed=21):
    """A lake with one vehicle of each kind, audited: (window, verdicts)."""
    rng, rows = np.random.default_rng(seed), []
    for kind, (motion, statuses, every) in KINDS.items():
        begin = days - 1 if kind == "last-day-alone" else days // 2
        rows += [
            r
            for r in vehicle_records(
                kind, days, rng, motion=lambda d, m=motion, b=begin: m if d >= b else {},
                status=lambda d, s=statuses: s.get(d, "accepted"),
            )
            if int(r.day[-2:]) % every == 0
        ]  # fmt: skip
    commit_records(lake, CALIBRATIONS, rows)
    audit_fleet(lake, fleet)
    return read_window(lake, "joint", days, "2100-01-01"), read_verdicts(lake, "joint")


def repeated(window, verdicts, count, rare=25):
    """The fleet as `count` vehicles, `rare` times as many of them good as of any other kind."""
    kinds = [k for k in KINDS for _ in range(rare if k.startswith("good") else 1)]
    names = [f"{kinds[i % len(kinds)].split('-')[0]}-{i:05d}" for i in range(count)]
    names = sorted(zip(names, (kinds[i % len(kinds)] for i in range(count)), strict=True))
    rows = [np.flatnonzero(window.owner == window.vehicles.index(kind)) for _, kind in names]
    charts = [np.flatnonzero(verdicts.charts.owner == verdicts.vehicles.index(kind)) for _, kind in names]
    at, on = np.concatenate(rows), np.concatenate(charts)
    owner, chart_owner = (np.repeat(np.arange(count), [len(r) for r in of]) for of in (rows, charts))
    return (
        picked(
            window, at, "day", "edge", "status", "T", "sigma", "observable", owner=owner,
            vehicles=[name for name, _ in names], work_key=[window.work_key[i] for i in at],
        ),
        replace(
            verdicts,
            vehicles=[name for name, _ in names],
            findings={name: [replace(f, vehicle=name) for f in verdicts.findings[kind]] for name, kind in names},
            charts=picked(verdicts.charts, on, "edge", "dof", "status", "limit", "start", owner=chart_owner),
        ),
    )  # fmt: skip


def picked(columns, rows, *names, **given):
    return replace(columns, **{name: getattr(columns, name)[rows] for name in names}, **given)


VEHICLES = 10_000


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    """A vehicle of each kind, audited: lake, window, verdicts."""
    lake = Lake.at(tmp_path_factory.mktemp("kinds") / "lake")
    return lake, *some_of_each_kind(lake, _config(), days=10)


def page_of(lake, window, verdicts, folder):
    album = Album(lake, _config(), "joint", folder / "fleet.html", LocalFiles())
    return render_fleet_page(album, window, verdicts, set(window.vehicle_days()))


@pytest.fixture(scope="module")
def large(kinds, tmp_path_factory):
    """The page of ten thousand vehicles."""
    lake, window, verdicts = kinds
    return page_of(lake, *repeated(window, verdicts, VEHICLES), tmp_path_factory.mktemp("large"))


def index_of(page):
    return json.loads(re.search(r'id="fleet">(.*?)</script>', page.read_text(), re.DOTALL)[1])


def weight(page):
    return page.stat().st_size, sum(f.stat().st_size for f in page.parent.rglob("*.js"))


@pytest.mark.slow
def test_a_page_of_ten_thousand_vehicles_weighs_little_and_ten_times_that_of_a_thousand(
    kinds, large, tmp_path
):
    lake, window, verdicts = kinds
    small = page_of(lake, *repeated(window, verdicts, VEHICLES // 10), tmp_path)
    bytes_large, beside_large = weight(large)
    bytes_small, beside_small = weight(small)
    assert bytes_large < 2e6  # what a person waits for; charts lie beside it
    assert bytes_large < 10.5 * bytes_small
    assert 9.5 < beside_large / beside_small < 10.5
    assert max(f.stat().st_size for f in large.parent.rglob("*.js")) < 5e5


def test_the_table_begins_with_what_needs_attention_and_has_every_vehicle_once(large):
    index = index_of(large)
    statuses = [row[1] for row in index["rows"]]
    assert statuses == sorted(statuses)
    assert len({row[0] for row in index["rows"]}) == VEHICLES
    since = [row[3] for row in index["rows"] if row[1] == 0]
    assert since == sorted(since, reverse=True)
    for row in index["rows"][:: VEHICLES // 50]:
        file = index["charts"]["of"][index["rows"].index(row)]
        assert f'"{row[0]}":' in (large.parent / index["charts"]["folder"] / file).read_text()
    held = next(row for row in index["rows"] if row[0].startswith("held-"))
    assert held[5] == "DDHDDRHDDH"  # each day's word, a capital where it has a page


def test_a_chart_s_numbers_are_the_records(kinds):
    _, window, verdicts = kinds
    charts = dict(fleet_charts(window, verdicts))
    assert set(charts) == set(KINDS)
    knocked = {(c[0], c[1]): c for c in charts["radar-knocked"]["charts"]}
    status, limit, start, values, sigmas = knocked[2, 2][2:]  # lidar-radar yaw
    assert (status, limit) == (0, 2500)
    days = charts["radar-knocked"]["days"]
    assert start[0] == days[5]
    before, after = np.array(values[:5]) / 1e4, np.array(values[5:]) / 1e4
    sigma = np.degrees(np.sqrt(covariance_of("lidar_radar")[2, 2]))
    np.testing.assert_allclose(np.array(sigmas) / 1e4, sigma, atol=2e-3)
    assert abs(before.mean()) < 2e-4  # relative to the level before the change
    assert abs(after.mean() - 1.0) < 4 * sigma / np.sqrt(5)
    held = charts["held"]
    refused = held["pairs"][0].index("r")
    assert all(chart[5][refused] is None for chart in held["charts"])


def test_a_repair_is_drawn_on_the_charts_of_its_sensor_and_their_level_is_that_since(kinds):
    _, window, verdicts = kinds
    before = dict(fleet_charts(window, verdicts))["radar-knocked"]
    day = before["days"][2]
    event = ServiceEvent(
        vehicle="radar-knocked", day=date.fromordinal(day).isoformat(), sensor="radar", kind="repair"
    )
    after = dict(fleet_charts(window, verdicts, [event]))["radar-knocked"]
    assert after["events"] == [[day, f"repair of the radar on {event.day}", [1, 2]]]
    yaw = next(c for c in after["charts"] if c[:2] == [2, 2])
    assert abs(np.mean(yaw[5][3:5])) < 2  # of the two days between repair and knock, in 1e-4 deg
    of_camera_lidar = [[c for c in own["charts"] if c[0] == 0] for own in (before, after)]
    assert of_camera_lidar[0] == of_camera_lidar[1]


@pytest.mark.browser
def test_ten_thousand_vehicles_are_searched_sorted_and_opened_offline(large, browser, tmp_path):
    assert browser.open(large) == []
    rows = "document.querySelectorAll('#list tbody tr:not(.gap)').length"
    first = "document.querySelector('#list tbody tr:not(.gap) a').textContent"
    count = "document.getElementById('count').textContent"
    assert browser.evaluate(count) == "10,000 vehicles"
    assert browser.evaluate(rows) < 100  # of ten thousand: those in view
    assert browser.evaluate("document.querySelectorAll('*').length") < 10_000
    assert browser.evaluate("document.documentElement.scrollWidth") <= 1366

    say(browser, "search", "good 09")
    found = [r for r in index_of(large)["rows"] if "good" in r[0] and "09" in r[0]]
    assert browser.evaluate(count) == f"{len(found):,} of 10,000 vehicles"
    say(browser, "search", "")
    browser.evaluate("document.querySelector('[data-status=\"1\"]').click()")
    yellow = sum(r[1] == 1 for r in index_of(large)["rows"])
    assert browser.evaluate(count) == f"{yellow:,} of 10,000 vehicles"
    assert browser.evaluate(first).startswith("last-")
    browser.evaluate("document.querySelector('[data-status=\"1\"]').click()")
    say(browser, "order", "name")
    assert browser.evaluate(first) == min(r[0] for r in index_of(large)["rows"])

    browser.evaluate("(() => { const l = document.getElementById('list'); l.scrollTop = l.scrollHeight; })()")
    settle(browser)
    last = "[...document.querySelectorAll('#list tbody tr:not(.gap) a[href^=\"#charts\"]')].pop()"
    name = browser.evaluate(f"{last}.textContent")
    assert name == max(r[0] for r in index_of(large)["rows"])
    browser.evaluate(f"{last}.click()")
    settle(browser)
    drawn = f"document.getElementById('charts-{name}').querySelector('svg')"
    assert browser.evaluate(f"{drawn}.querySelectorAll('circle').length") >= 18
    assert browser.evaluate("document.activeElement.textContent").startswith(name)
    browser.screenshot(tmp_path / "shot.png")


@pytest.mark.browser
def test_a_page_that_lost_the_files_beside_it_says_which(large, browser, tmp_path):
    shutil.copy(large, tmp_path / "fleet.html")
    name = index_of(large)["rows"][0][0]
    assert all("failed" in p or "log" in p for p in browser.open(tmp_path / "fleet.html"))
    settle(browser)
    said = browser.evaluate(f"document.getElementById('charts-{name}').textContent")
    assert f"No charts of this vehicle in fleet_charts/{index_of(large)['charts']['of'][0]}" in said


@pytest.mark.browser
def test_the_script_draws_the_rows_that_the_page_came_with(kinds, browser, tmp_path):
    page = page_of(*kinds, tmp_path)
    came = re.findall(r"<tr><td><a href=\"#charts.*?</tr>", page.read_text().split("<tbody>")[1])
    assert browser.open(page) == []
    drawn = browser.evaluate("[...document.querySelectorAll('#list tbody tr')].map(r => r.outerHTML)")
    plain = [re.sub(r' (aria-rowindex="\d+"|class="words" title="[^"]*")', "", row) for row in drawn]
    same = [re.sub(r' class="words"', "", row) for row in came if 'class="days"' in row]
    attributes = re.compile(r'class="(c \w+)" href="([^"]*)" title="([^"]*)"')
    assert [attributes.sub(r'class="\1" title="\3" href="\2"', row) for row in same] == plain
    # All charts of a small fleet are in the page.
    assert not list(tmp_path.rglob("*.js"))
    for name in KINDS:
        browser.evaluate(f"document.querySelector('#list a[href=\"#charts-{name}\"]').click()")
        drawn = f"document.getElementById('charts-{name}').querySelectorAll('circle').length"
        assert browser.evaluate(drawn) >= 18


def say(browser, field, value):
    """Type into a field, or choose."""
    browser.evaluate(
        f"(() => {{ const f = document.getElementById('{field}'); f.value = {json.dumps(value)};"
        "f.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )


def settle(browser):
    browser.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done, 300)))")


@given(st.lists(st.text(min_size=1, max_size=12).filter(is_vehicle), min_size=2, max_size=8, unique=True))
def test_no_two_vehicles_pages_have_one_name_on_any_file_system(names):
    stems = [page_stem(name) for name in names]
    assert len({stem.casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert re.fullmatch(r"[a-z0-9._~-]+", stem)
        assert not stem.startswith(".")


@pytest.mark.parametrize(
    "names", [("Car", "car", "CAR"), ("a b", "a_b"), ("con", "con."), ("ä", "ae", "a\u0308")]
)
def test_names_that_file_systems_take_for_one_have_pages_of_their_own(names):
    stems = {page_stem(name).casefold() for name in names}
    assert len(stems) == len(names)
    assert stems.isdisjoint({"con", "nul", "aux"})
