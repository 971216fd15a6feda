"""Which sensor moved: motions of one sensor, built by SE(3) algebra, with noise."""

from types import ModuleType

import numpy as np
import pytest

from pipeline.audit.attribution import PairShift, attribute, independent_pairs, pair_shift
from pipeline.geometry.se3 import adjoint, exp_se3, inverse, log_se3

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])  # a turned bracket: yaw and a little sideways


def _shifts(maker: ModuleType, moved: dict[str, np.ndarray], seed: int) -> dict[str, PairShift]:
    rng = np.random.default_rng(seed)
    records = maker.vehicle_records("v", 4, rng, motion=lambda day: moved if day > 1 else {})
    shifts = {}
    for pair in ("camera_lidar", "lidar_radar", "camera_radar"):
        rows = [r for r in records if r.pair == pair]
        from pipeline.store.current import transform_of

        T = np.stack([transform_of(r) for r in rows])
        shifts[pair] = pair_shift(T, np.stack([r.covariance for r in rows]), np.array([0, 0, 1, 1], bool))
    return shifts


@pytest.mark.parametrize(("sensor", "twist"), [
    ("radar", KNOCK),
    ("camera", np.array([0, np.radians(0.4), 0, 0, 0, 0])),
    ("lidar", np.array([0, np.radians(0.5), np.radians(0.3), 0, 0, 0])),
])  # fmt: skip
def test_the_moved_sensor_is_named_with_its_motion_in_its_own_axes(
    maker: ModuleType, sensor: str, twist: np.ndarray
) -> None:
    named, normalised = 0, []
    for seed in range(60):
        found = attribute(_shifts(maker, {sensor: twist}, seed))
        assert found.sensor in (sensor, None)
        if found.sensor == sensor:
            named += 1
            error = found.motion - twist
            normalised.append(error @ np.linalg.solve(found.covariance, error))
    assert named >= 57
    assert 4.5 < np.mean(normalised) < 7.5  # chi-squared with 6 degrees of freedom


def test_a_motion_lost_in_the_noise_is_not_pinned_on_a_sensor(maker: ModuleType) -> None:
    answers = [attribute(_shifts(maker, {}, seed)).sensor for seed in range(40)]
    assert answers.count(None) >= 30


def test_two_sensors_that_moved_apart_are_not_blamed_on_one(maker: ModuleType) -> None:
    both = {"camera": np.array([0, 0.02, 0, 0, 0, 0]), "radar": np.array([0, 0, -0.03, 0, 0.1, 0])}
    found = attribute(_shifts(maker, both, 0))
    assert found.sensor is None
    assert "no single sensor" in found.explanation


def test_one_pair_alone_cannot_tell(maker: ModuleType) -> None:
    shifts = _shifts(maker, {"radar": KNOCK}, 0)
    assert attribute({"lidar_radar": shifts["lidar_radar"]}).sensor is None


def test_a_composed_pair_is_not_counted_as_a_third_witness(maker: ModuleType) -> None:
    shifts = _shifts(maker, {"radar": KNOCK}, 0)
    assert independent_pairs(shifts) == ("camera_lidar", "lidar_radar")
    own = PairShift(exp_se3(np.full(6, 1e-3)) @ shifts["camera_radar"].T, np.zeros(6), np.eye(6))
    assert len(independent_pairs(shifts | {"camera_radar": own})) == 3


def test_three_independent_pairs_agree_on_the_sensor() -> None:
    rng = np.random.default_rng(1)
    T_cl, T_lr = exp_se3(rng.normal(size=6)), exp_se3(rng.normal(size=6))
    T = {"camera_lidar": T_cl, "lidar_radar": T_lr, "camera_radar": exp_se3(np.full(6, 1e-3)) @ T_cl @ T_lr}
    cov = np.diag([1e-7] * 3 + [1e-4] * 3)
    xi = {p: np.zeros(6) for p in T}
    for pair in ("lidar_radar", "camera_radar"):
        xi[pair] = log_se3(T[pair] @ exp_se3(KNOCK) @ inverse(T[pair]))
        np.testing.assert_allclose(xi[pair], adjoint(T[pair]) @ KNOCK, atol=1e-9)
    found = attribute({p: PairShift(T[p], xi[p], cov) for p in T})
    assert found.sensor == "radar"
    np.testing.assert_allclose(found.motion, KNOCK, atol=1e-9)
