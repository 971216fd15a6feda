"""Gradients along paint: a line ahead that grows brighter towards the car draws pitch, and the bias says how far."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.borders import _of_image, along_paint
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.se3 import inverse, transform_points
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

STATE = AlignmentState(T_TRUE)
NONE = np.zeros(8, bool)
PRIOR = np.diag(1 / np.array([0.035] * 3 + [0.05] * 3 + [0.02, 0.002]) ** 2)


def stripe(angle_deg, growth):
    """A line through the middle of an image of 80 x 120, and its brightness by row."""
    v, u = np.mgrid[:80, :120].astype(float)
    across = np.cos(np.radians(angle_deg)) * (u - 60) + np.sin(np.radians(angle_deg)) * (v - 40)
    return np.round(60 * np.exp(-0.5 * (across / 3) ** 2) * (1 + growth * (v - 40) / 40)).astype(np.int8)


AROUND = np.array([[58.0, 40.0], [60.0, 38.0], [62.5, 42.0]])


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, -50.0])
def test_an_even_line_has_no_gradient_along_itself_in_whatever_direction_it_runs(angle_deg):
    whole, along = _of_image(stripe(angle_deg, 0.0), AROUND)
    assert np.abs(whole).max() > 3
    assert np.abs(along).max() < 0.3


@pytest.fixture(scope="module")
def terms():
    day = traced_day(DENSE, 6, seed=1)
    return prepare_terms(day, T_TRUE, np.zeros((len(day), 3)), reach_rad=0.03)


def line_ahead(terms, growth):
    """The terms with nothing but a line straight ahead: marked points on it, and its image in every frame."""
    camera = terms.maps.camera
    height, width = terms.maps.contrast.shape[2:]
    ray = np.column_stack([np.zeros(200), np.full(200, 1.5), np.geomspace(4.0, 60.0, 200)])  # in camera axes
    pixels, is_seen = camera.project(ray)
    inside = is_seen & np.all((pixels > 2) & (pixels < [width - 3, height - 3]), axis=1)
    pixels, ray = pixels[inside], ray[inside]
    v, u = np.mgrid[:height, :width].astype(float)
    rows = np.argsort(pixels[:, 1])
    at_u = np.interp(v[:, 0], pixels[rows, 1], pixels[rows, 0])[:, None]
    middle, half = np.mean(pixels[[0, -1], 1]), np.ptp(pixels[:, 1]) / 2
    image = np.round(
        60 * np.exp(-0.5 * ((u - at_u) / 3) ** 2) * np.clip(1 + growth * (v - middle) / half, 0, 2)
    )
    contrast = np.broadcast_to(image.astype(np.int8), terms.maps.contrast.shape).copy()
    xyz = np.tile(transform_points(inverse(T_TRUE), ray), (terms.frames, 1)).astype(np.float32)
    n, none = len(ray), np.zeros(len(xyz), np.uint8)
    zero = np.zeros(len(xyz), np.float32)
    start = np.arange(terms.frames + 1) * n
    points = Points(xyz, start, none, none, zero, zero, np.arange(terms.frames))
    only = terms.of_kinds(edges=False, markings=True)
    return replace(only, markings=points, maps=replace(terms.maps, contrast=contrast))


def drawn(terms, fixed=NONE):
    kernel = replace(KernelSettings.wide(1.5, 2), marking_weight=1.0, delta=1.0)
    edges = terms.of_kinds(edges=True, markings=False).gradient(STATE.alone, kernel)[1].sum(0)
    return along_paint(terms, STATE, kernel, edges + PRIOR, fixed)[0]


def test_a_line_ahead_that_grows_brighter_draws_pitch_and_an_even_one_does_not(terms):
    even, growing = (drawn(line_ahead(terms, growth)) for growth in (0.0, 0.4))
    assert np.abs(even[:3]).max() < np.radians(0.05)
    assert np.abs(growing[0]) > 10 * max(np.abs(even[0]), np.radians(0.02))
    assert np.abs(growing[1]) < 0.2 * np.abs(growing[0])
    fixed = drawn(line_ahead(terms, 0.4), np.arange(8) < 3)
    assert (fixed[:3] == 0).all()


def test_paint_of_a_road_with_arrows_and_lines_to_the_sides_draws_nothing(terms):
    assert np.abs(drawn(terms)[:3]).max() < np.radians(0.03)
