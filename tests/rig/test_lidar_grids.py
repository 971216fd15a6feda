"""Rows are found where a lidar draws them; range images, and the vote of the pixels around a point."""

import numpy as np
import pytest

from pipeline.rig.scan_rows import EMPTY, channels_of, project, rows_of, vote_of_neighbours
from tests.makers.range_scenes import DOWN, SIZE, UP, full_image, points_of


def scanner(rows=16, columns=200, spacing_deg=2.0, droop_deg=0.0, jitter_deg=0.0, seed=0):
    """Azimuth, elevation, range of a scanner whose rows may sag towards the sides, and the row of each point."""
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    azimuth = np.radians(np.linspace(-40, 40, columns)[column])
    sag = droop_deg * np.linspace(-1, 1, columns)[column] ** 2
    elevation = np.radians(spacing_deg * (row - rows / 2) - sag)
    elevation = elevation + np.radians(jitter_deg) * np.random.default_rng(seed).standard_normal(row.shape)
    aer = np.stack([azimuth.ravel(), elevation.ravel(), np.full(row.size, 20.0)], 1)
    return aer, row.ravel().astype(np.int32)


@pytest.mark.parametrize(
    "shape", [{}, {"droop_deg": 5.0}, {"jitter_deg": 0.05}, {"rows": 128, "spacing_deg": 0.125}, {"rows": 1}]
)
def test_rows_that_are_logged_are_rows_whatever_their_numbering(shape):
    aer, row = scanner(**shape)
    numbering = np.random.default_rng(1).permutation(row.max() + 1).astype(np.uint16)
    shuffled = np.random.default_rng(2).permutation(len(row))
    found = rows_of(aer[shuffled], numbering[row][shuffled]).row
    np.testing.assert_array_equal(found, row[shuffled])


def turns_stored_one_after_the_other(begin_deg, missing):
    """Beams that start side by side, as of an HDL-64, with a near thing on one side; row of each point."""
    row, column = np.meshgrid(np.arange(32), np.arange(1200), indexing="ij")
    place = np.radians(0.3 * column + 0.01 * row)
    range_m = np.where(
        (place > 1.8) & (place < 2.2), 3.0, 1.8 / np.maximum(0.05 + 0.01 * np.sin(9 * place), 0.03) - row
    )
    range_m = np.maximum(range_m, 3.0)
    elevation = np.radians(0.4 * (15 - row)) + np.where(row < 16, 0.12, -0.15) / range_m
    azimuth = (np.radians(begin_deg) + place + np.pi) % (2 * np.pi) - np.pi
    keep = np.random.default_rng(3).random(row.shape) > missing
    keep &= ~((row == 0) & (column < 40)) & ~((row == 31) & (column > 1150))
    return np.stack([azimuth[keep], elevation[keep], range_m[keep]], 1), 31 - row[keep]


@pytest.mark.parametrize("begin_deg", [0.0, -180.0, 75.0])
def test_turns_that_are_stored_one_after_the_other_are_rows(begin_deg):
    aer, row = turns_stored_one_after_the_other(begin_deg, missing=0.2)
    assert np.mean(rows_of(aer, None).row != row) < 1e-3
    clockwise = aer * [-1, 1, 1]
    assert np.mean(rows_of(clockwise, None).row != row) < 1e-3
    shuffled = np.random.default_rng(4).permutation(len(row))
    found = rows_of(aer[shuffled], None).row
    assert found is None or np.mean(found != row[shuffled]) > 0.1  # it was the order that told


def test_lasers_of_a_rosette_are_no_rows():
    t = np.arange(4000) / 40000
    turns = [2 * np.pi * f * t[:, None] + np.arange(6) * p for f, p in ((121.57, 1.0), (-77.73, 2.1))]
    azimuth, elevation = 0.7 * sum(np.cos(w) for w in turns) / 2, 0.2 * sum(np.sin(w) for w in turns) / 2
    aer = np.stack([azimuth.ravel(), elevation.ravel(), np.full(azimuth.size, 20.0)], 1)
    for ring in (np.tile(np.arange(6), 4000).astype(np.uint16), np.zeros(24000, np.uint16), None):
        assert rows_of(aer, ring) is None


def test_the_order_is_by_row_then_by_azimuth_then_as_stored():
    aer, _ = scanner(rows=4, columns=40)
    twice = np.random.default_rng(3).permutation(np.repeat(np.arange(len(aer)), 2))
    found = rows_of(aer[twice], None)
    np.testing.assert_array_equal(found.order, np.lexsort((aer[twice, 0], found.row)))


KNN = {"neighbours": 5, "search": 5, "sigma_px": 1.0, "cutoff_m": 1.0}
CAR, ROAD, BUILDING = 1, 9, 13  # of semantickitti


def test_points_through_pixel_centres_fall_into_their_pixels():
    points = full_image()
    image = project(points, SIZE, UP, DOWN)
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    assert image.inside.all()
    assert np.array_equal(image.row, rows.ravel())
    assert np.array_equal(image.column, columns.ravel())
    assert np.array_equal(image.point.ravel(), np.arange(len(points)))
    assert image.range_m == pytest.approx(10.0)


def test_of_points_in_one_pixel_the_nearest_is_drawn_whatever_their_order():
    ranges = np.array([30.0, 5.0, 12.0])
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        image = project(points_of([9] * 3, [44] * 3, ranges[order]), SIZE, UP, DOWN)
        assert image.range_m[9, 44] == pytest.approx(5.0)
        assert order[image.point[9, 44]] == 1
        assert np.sum(image.point != EMPTY) == 1


def test_channels_are_the_drawn_points_and_minus_one_elsewhere():
    points = points_of([3, 3, 20], [7, 7, 300], [8.0, 40.0, 15.0])
    remission = np.array([0.1, 0.2, 0.3], np.float32)
    channels = channels_of(project(points, SIZE, UP, DOWN), points, remission)
    assert channels[:, 3, 7] == pytest.approx([8.0, *points[0], 0.1], abs=1e-5)
    assert channels[:, 20, 300] == pytest.approx([15.0, *points[2], 0.3], abs=1e-5)
    assert np.sum(channels != -1) == 10


def test_points_beyond_the_field_of_view_are_neither_drawn_nor_labelled():
    points = points_of([-0.8, -5, 32.3, 10], [7, 8, 9, 10], [8.0] * 4)
    image = project(points, SIZE, UP, DOWN)
    assert image.inside.tolist() == [True, False, False, True]
    assert np.sum(image.point != EMPTY) == 2
    labels = vote_of_neighbours(image, np.full(SIZE, ROAD), 20, **KNN)
    assert labels.tolist() == [ROAD, 0, 0, ROAD]


def brute_vote(image, labels, n):
    """One point's label, pixel by pixel: the definition."""
    offsets = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]
    gauss = {o: np.exp(-(o[0] ** 2 + o[1] ** 2) / 2) for o in offsets}
    total = sum(gauss.values())
    found = []
    for i, j in offsets:
        row, column = image.row[n] + i, (image.column[n] + j) % SIZE[1]
        if 0 <= row < SIZE[0] and image.point[row, column] != EMPTY:
            difference = abs(image.range_m[row, column] - image.point_range_m[n])
            distance = 0.0 if (i, j) == (0, 0) else difference * (1 - gauss[i, j] / total)
            found.append((distance, labels[row, column]))
    votes = np.zeros(20)
    for distance, label in sorted(found, key=lambda f: f[0])[:5]:
        votes[label] += distance <= 1.0
    votes[0] = 0
    return int(np.argmax(votes))


def test_votes_are_those_of_the_definition():
    rng = np.random.default_rng(3)
    count = 9000
    rows, columns = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
    points = points_of(rows, columns, rng.uniform(4, 9, count))
    image = project(points, SIZE, UP, DOWN)
    labels = rng.integers(0, 5, SIZE)
    found = vote_of_neighbours(image, labels, 20, **KNN)
    some = rng.choice(count, 800, replace=False)
    assert found[some].tolist() == [brute_vote(image, labels, n) for n in some]
