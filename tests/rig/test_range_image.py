"""Range images: projection, and the vote of the pixels around a point on its label."""

import numpy as np
import pytest

from pipeline.rig.range_image import EMPTY, channels_of, project, vote_of_neighbours
from tests.makers.range_scenes import DOWN, SIZE, UP, full_image, points_of

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


# votes


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
