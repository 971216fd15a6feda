"""The page of evaluate: tables as given, a dot per run, pictures at both states, and a browser without complaints."""

import numpy as np
import pytest

from pipeline.report.evaluation import EvaluatedRun, View, evaluation_page
from schemas.calibrations import PAIRS
from tests.report.test_pictures import GOOD, _scene, _turned

PLACES_M = np.array([[15.0, -2.0, 0.0], [25.0, 3.0, 0.0], [40.0, 0.0, 0.0]])


def run(method, error_deg):
    errors = {pair: np.array([error_deg, error_deg / 2, 0.05]) for pair in PAIRS}
    priors = {pair: np.array([2.0, 1.0, 0.2]) for pair in PAIRS}
    return EvaluatedRun("car 2026-01-01", method, errors, priors, PLACES_M, PLACES_M + 0.5, PLACES_M + 0.02)


def tables():
    rows = [(False, ["joint", "2"]), (True, ["paper: joint SSL", "other"])]
    return [{"title": "Table 1", "header": ["method", "runs"], "lines": rows}]


def test_every_run_is_a_dot_per_pair_and_every_prior_a_cross():
    html = evaluation_page(tables(), [run("joint", 0.02), run("tracking", 0.3)], [], {}, ["positions picked"])
    assert html.count("car 2026-01-01, joint: 0.020 / 0.010 deg") == 3
    assert html.count("car 2026-01-01, tracking: 0.300 / 0.150 deg") == 3
    assert html.count("car 2026-01-01, prior: 2.000 / 1.000 deg") == 6
    assert html.count("result: 3.5 cm off") == 3  # 2 cm along each axis
    assert "positions picked" in html


def test_the_paper_s_lines_are_set_apart_and_missing_parts_are_left_out():
    html = evaluation_page(tables(), [], [], {}, [], no_views="no frames")
    assert '<tr class="unseen"><td>paper: joint SSL</td>' in html
    assert "<tr><td>joint</td>" in html
    assert "No pictures: no frames" in html
    assert "Every run" not in html


def test_honest_sigmas_follow_the_grey_curve_and_small_ones_lie_below():
    z = np.random.default_rng(0).standard_normal(4000)
    heights = []
    for scale in (1.0, 2.0):
        html = evaluation_page(tables(), [run("joint", 0.1)], [], {"joint": scale * z}, [])
        curves = [p.split('"')[0].split() for p in html.split('<polyline points="')[1:]]
        at_one = [float(curve[20].split(",")[1]) for curve in curves]  # 20 of 80 steps to 4 sigma; down is +
        heights.append(at_one[1] - at_one[0])
    assert abs(heights[0]) < 10
    assert heights[1] > 50


@pytest.mark.browser
def test_a_browser_shows_the_page_without_a_complaint_and_not_wider_than_a_laptop(browser, tmp_path):
    views = [
        View("urban: alignment", _scene(), _turned(3.0), GOOD, True, "car 2026-01-01, joint."),
        View("Abrupt change", _scene(), _turned(3.0), GOOD, False, "car 2026-01-01, joint."),
    ]
    z = {"joint": np.linspace(-2, 2, 30)}
    page = tmp_path / "page.html"
    page.write_text(evaluation_page(tables(), [run("joint", 0.02)], views, z, []))
    assert browser.open(page) == []
    assert browser.evaluate("document.documentElement.scrollWidth") <= 1366
    assert browser.evaluate("document.querySelectorAll('img').length") == 3  # one of two states, two of one
    assert browser.evaluate("[...document.images].every(i => i.naturalWidth > 0)")
