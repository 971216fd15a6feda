"""Rows are found where a lidar draws them, and nowhere else."""

import numpy as np
import pytest

from pipeline.rig.scan_rows import rows_of


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
