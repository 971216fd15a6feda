"""Point clouds of any layout give the numbers that were put in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ingest.messages.point_cloud import cloud_columns, first_field, read_lidar

INTEGER = {"i1": 100, "u1": 200, "i2": 3000, "u2": 6000, "i4": 10**6, "u4": 10**6}
STAMP = 1_700_000_000_123_456_789


@settings(max_examples=60, deadline=None)
@given(
    big_endian=st.booleans(), padding=st.integers(0, 5), rows=st.sampled_from([1, 4]),
    row_padding=st.integers(0, 7),
    kinds=st.lists(st.sampled_from(["f4", "f8", *INTEGER]), min_size=1, max_size=6), seed=st.integers(0, 1000),
)  # fmt: skip
def test_any_layout_gives_back_its_columns(kit, big_endian, padding, rows, row_padding, kinds, seed):
    rng = np.random.default_rng(seed)
    columns = {f"f{i}": column(kind, rng) for i, kind in enumerate(kinds)}
    layout = {"big_endian": big_endian, "padding": padding, "rows": rows}
    message = kit.Kit().cloud(0, columns, **layout, row_padding=row_padding if rows > 1 else 0)
    points = cloud_columns(message)
    for name, values in columns.items():
        np.testing.assert_array_equal(points[name], values)


def column(kind, rng):
    values = rng.integers(0, INTEGER[kind], 40) if kind in INTEGER else rng.normal(size=40)
    return values.astype(kind)


def test_a_field_of_several_values_does_not_disturb_the_others(kit):
    columns = {"descriptor": np.arange(30.0).reshape(10, 3).astype("f4"), "x": np.arange(10, dtype="f4")}
    points = cloud_columns(kit.Kit().cloud(0, columns, counts={"descriptor": 3}))
    np.testing.assert_array_equal(points["x"], columns["x"])
    assert first_field(points, ("descriptor",)) is None  # several values are no column


@pytest.mark.parametrize("kind_of_ring", ["u2", "f4"])
def test_points_without_return_nan_and_far_ones_are_dropped_and_counted(kit, kind_of_ring):
    columns = kit.lidar(0, 12)
    columns["ring"] = columns["ring"].astype(kind_of_ring)
    columns["x"][:3] = np.nan
    columns["z"][3] = np.inf
    for name in "xyz":
        columns[name][4:6] = 0
    columns["y"][6] = 500.0
    cloud = read_lidar(kit.Kit().cloud(STAMP, columns), STAMP, 120.0)
    dropped = {"not_finite": 4, "without_return": 2, "beyond_range": 1}
    assert dict(cloud.dropped) == {f"lidar_points_{why}": n for why, n in dropped.items()}
    np.testing.assert_array_equal(cloud.x_m, columns["x"][7:])
    np.testing.assert_array_equal(cloud.ring, columns["ring"][7:])
    np.testing.assert_array_equal(cloud.intensity, columns["intensity"][7:])
    np.testing.assert_array_equal(cloud.time_s, columns["time"][7:])


def test_double_precision_garbage_is_not_finite_rather_than_an_overflow(kit):
    columns = {n: np.full(3, 1.0) for n in "xyz"}
    columns["x"][0], columns["y"][1] = 1e300, 1e30
    cloud = read_lidar(kit.Kit().cloud(0, columns), STAMP, 120.0)
    assert len(cloud.x_m) == 1
    assert sum(cloud.dropped.values()) == 2


SWEEP_S = np.linspace(-0.1, 0.0, 5)


@pytest.mark.parametrize(
    ("name", "values", "is_time"),
    [
        ("time", SWEEP_S.astype("f4"), True),
        ("time", SWEEP_S, True),
        ("t", (np.arange(5) * 25_000_000 - 100_000_000).astype("i4"), True),
        ("timestamp", STAMP * 1e-9 + SWEEP_S, True),
        ("time", np.full(5, np.nan, "f4"), False),
        ("time", np.full(5, 12.0, "f4"), False),
        ("time", np.full(5, 1.7e9, "f4"), False),
        ("time", np.arange(5).astype("u4") * 10**9, False),
    ],
)
def test_times_in_every_convention_become_seconds_after_the_stamp_or_are_left_out(kit, name, values, is_time):
    columns = {n: np.full(5, 3.0, "f4") for n in "xyz"} | {name: values}
    cloud = read_lidar(kit.Kit().cloud(0, columns), STAMP, 120.0)
    assert (cloud.time_s is not None) == is_time
    if is_time:
        # A double holds today's date to 0.2 microseconds, a float32 holds 0.1 s to 4 ns.
        np.testing.assert_allclose(cloud.time_s, SWEEP_S, atol=5e-7)


@pytest.mark.parametrize(
    ("name", "value"),
    [("width", 11), ("point_step", 0), ("point_step", 5), ("width", 2**31), ("data", slice(-1))],
)
def test_a_layout_that_contradicts_itself_is_refused(kit, name, value):
    broken = kit.Kit().cloud(0, kit.lidar(0, 10))
    setattr(broken, name, broken.data[value] if name == "data" else value)
    with pytest.raises(ValueError, match=r"\w"):
        cloud_columns(broken)
    whole = kit.Kit().cloud(0, kit.lidar(0, 10))
    whole.fields[0].datatype = 99
    with pytest.raises(ValueError, match="datatype 99"):
        cloud_columns(whole)


def test_a_cloud_without_coordinates_names_what_it_has(kit):
    message = kit.Kit().cloud(0, {"range": np.ones(3, "f4"), "azimuth": np.ones(3, "f4")})
    with pytest.raises(ValueError, match="there are range, azimuth"):
        read_lidar(message, STAMP, 120.0)
