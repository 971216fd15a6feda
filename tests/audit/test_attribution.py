"""Which sensor moved: motions of one sensor, built by SE(3) algebra, with noise."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from pipeline.audit.days import PairDays
from pipeline.audit.scan import alike
from pipeline.audit.vehicle import Whitened, independent_edges
from pipeline.rig.attribution import PairShift, attribute
from pipeline.rig.graph import BASE, EDGE_OF_PAIR, Edge, Sensor, edge_between
from pipeline.rig.se3 import adjoint, exp_se3, from_rotation_translation, inverse
from tests.audit.fleet_records import days_of, vehicle_records

# Sigmas of an edge's shift between the days before a change and those after it, in its parent's axes [deg, m]: what
# some days of each kind of edge give. What a kind does not show is as unsure as a prior.
UNSURE_DEG, UNSURE_M = 2.0, 0.1
SHIFT_SIGMAS = {
    "camera_lidar": ([0.03, 0.03, 0.05], [0.03, 0.03, 0.05]),
    "camera_radar": ([0.3, 0.08, UNSURE_DEG], [UNSURE_M] * 3),
    "lidar_radar": ([UNSURE_DEG, 0.4, 0.05], [UNSURE_M] * 3),
    "lidar_lidar": ([0.03, 0.03, 0.03], [0.02, 0.02, 0.02]),
    "lidar_base": ([0.05, 0.05, 0.1], [UNSURE_M, UNSURE_M, 0.02]),
    "camera_base": ([0.05, 0.05, 0.1], [UNSURE_M, UNSURE_M, 0.02]),
    "radar_base": ([UNSURE_DEG, 0.4, 0.1], [UNSURE_M] * 3),
}
# Axes as cameras have them, seen from bodies' axes.
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Rig:
    """A random rig of eight sensors, and what its edges show of motions."""

    def __init__(self, rng, *, edges=16, with_base=False):
        kinds = ["lidar", "lidar", *rng.choice(["camera", "radar"], 6)]
        self.sensors = [Sensor(f"s{i}", str(kind)) for i, kind in enumerate(kinds)]
        self.sensors += [BASE] if with_base else []
        self.T = {s.name: self._pose(s, rng) for s in self.sensors}
        possible = []
        for i, b in enumerate(self.sensors):
            for a in self.sensors[:i]:
                with contextlib.suppress(ValueError):  # two cameras, two radars
                    possible.append(edge_between(a, b))
        # Each sensor on the first lidar, then others.
        tree = [e for e in possible if "s0" in (e.parent.name, e.child.name)]
        rest = [e for e in possible if e not in tree]
        chosen = rng.permutation(len(rest))[: max(edges - len(tree), 0)]
        self.edges = [*tree, *(rest[i] for i in chosen)]

    def _pose(self, sensor, rng):
        """Upright, looking anywhere, within two metres."""
        yaw = exp_se3(np.r_[0, 0, rng.uniform(-3, 3), rng.uniform(-2, 2, 3)])
        R = R_BODY_CAMERA if sensor.kind == "camera" else np.eye(3)
        return yaw @ from_rotation_translation(R, np.zeros(3))

    def degree(self, name):
        return sum(name in (e.parent.name, e.child.name) for e in self.edges)

    def shifts(self, moved, rng):
        found = {}
        for edge in self.edges:
            T = inverse(self.T[edge.parent.name]) @ self.T[edge.child.name]
            rotation, shift = SHIFT_SIGMAS[edge.kind]
            covariance = np.diag(np.r_[np.radians(rotation), shift] ** 2)
            xi = rng.multivariate_normal(np.zeros(6), covariance)
            xi += adjoint(T) @ moved.get(edge.child.name, np.zeros(6))
            xi -= moved.get(edge.parent.name, np.zeros(6))
            found[edge] = PairShift(T, xi, covariance)
        return found


def knock(rng, sensor):
    """Half a degree about any axis; of a radar, which measures azimuth alone well, yaw."""
    axis = np.array([0.0, 0.0, 1.0]) if sensor.kind == "radar" else rng.normal(size=3)
    return np.r_[np.radians(0.5) * axis / np.linalg.norm(axis), np.zeros(3)]


CAMERA_LIDAR, CAMERA_RADAR, LIDAR_RADAR = map(
    EDGE_OF_PAIR.get, ("camera_lidar", "camera_radar", "lidar_radar")
)
STILL = np.zeros(6)
KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])  # a turned bracket: yaw and a little sideways


def _days(moved, seed):
    rng = np.random.default_rng(seed)
    return days_of(vehicle_records("v", 4, rng, motion=lambda day: moved if day > 1 else {}), 2.0)


def _shifts(moved, seed):
    days, is_after = _days(moved, seed), np.array([0.0, 0, 1, 1])
    own = independent_edges(days, days[CAMERA_LIDAR].day)
    return {pair: Whitened.of(d, STILL, STILL).shift(is_after) for pair, d in own.items()}


def test_a_motion_lost_in_the_noise_is_not_pinned_on_a_sensor():
    answers = [attribute(_shifts({}, seed)).sensor for seed in range(40)]
    assert answers.count(None) >= 30


def test_a_scale_that_few_days_told_does_not_hide_who_moved():
    """Scales drawn as sure as ten degrees of freedom tell them: the misfit's own level holds, two movers still show."""
    rng, named, by_known_scale = np.random.default_rng(7), 0, 0
    for seed in range(200):
        shifts = _shifts({"radar": KNOCK}, seed)
        told = rng.chisquare(10) / 10
        shifts = {p: replace(s, covariance=s.covariance * told) for p, s in shifts.items()}
        named += attribute(shifts, 10.0).sensor == "radar"
        by_known_scale += attribute(shifts).sensor == "radar"
    assert by_known_scale < named
    assert named >= 197
    both = {"camera": np.array([0, 0.02, 0, 0, 0, 0]), "radar": np.array([0, 0, -0.03, 0, 0.1, 0])}
    assert attribute(_shifts(both, 0), 10.0).sensor is None


def test_a_composed_pair_is_not_counted_as_a_third_witness():
    days = _days({"radar": KNOCK}, 0)
    last = days[CAMERA_LIDAR].day
    assert set(independent_edges(days, last)) == {CAMERA_LIDAR, LIDAR_RADAR}
    own = replace(days[CAMERA_RADAR], T=exp_se3(np.full(6, 1e-3)) @ days[CAMERA_RADAR].T)
    assert len(independent_edges(days | {CAMERA_RADAR: own}, last)) == 3


@pytest.mark.parametrize("reference_days", [0, 10])
def test_a_shift_through_days_that_err_alike_is_as_unsure_as_it_says(reference_days: int):
    rng = np.random.default_rng(3)
    # The fourth day was held: three times as unsure, for reasons of its own.
    spread = np.repeat(np.eye(6)[None], 8, axis=0) * 1e-6
    spread[3] *= 9
    day = np.array([0, 1, 2, 3, 5, 6, 7, 9]) + np.r_[0, [40 * (reference_days > 0)] * 7]
    found = []
    for _ in range(1500):
        e = np.zeros((50, 6))
        for k in range(50):
            e[k] = rng.normal(size=6) if not k else 0.6 * e[k - 1] + 0.8 * rng.normal(size=6)
        change = 1e-3 * e[day]
        change[3] += 1e-3 * np.sqrt(8) * rng.normal(size=6)
        if reference_days:  # a mean of ten days whose own errors are those of independent ones
            change[0] = 1e-3 * rng.normal(size=6) * np.sqrt(alike(np.array([10]), np.array([0.6])))
        days = PairDays(
            day, np.repeat(np.eye(4)[None], 8, axis=0), change, spread, np.ones((8, 6), bool), np.ones(8, bool),
            np.eye(4), reference_days,
        )  # fmt: skip
        found.append(Whitened.of(days, np.full(6, 0.6), STILL).shift((np.arange(8) >= 3).astype(float)))
    scatter = np.std([s.xi for s in found])
    assert scatter == pytest.approx(np.sqrt(found[0].covariance[0, 0]), rel=0.04)


def test_the_day_of_a_step_is_the_split_that_gains_most():
    rng = np.random.default_rng(4)
    spread = np.repeat(np.eye(6)[None], 12, axis=0) * 1e-6
    change = 1e-3 * rng.normal(size=(12, 6))
    change[7:, 4] += 8e-3
    every = np.ones((12, 6), bool)
    T = np.repeat(np.eye(4)[None], 12, axis=0)
    days = PairDays(np.arange(12), T, change, spread, every, every[:, 0], np.eye(4))
    gains = Whitened.of(days, np.full(6, 0.4), STILL).step_gains()
    assert int(np.argmax(gains)) == 6
    whitened = Whitened.of(days, STILL, STILL)
    for s in range(11):  # of days that err independently, the gain of means by their covariances
        size = change[s + 1 :].mean(axis=0) - change[: s + 1].mean(axis=0)
        expected = size @ size / (1e-6 * (1 / (s + 1) + 1 / (11 - s)))
        assert whitened.step_gains()[s] == pytest.approx(expected)


# -- rigs of many sensors ----------------------------------------------------------------------------


def test_of_eight_sensors_the_one_that_was_knocked_is_named_and_no_other():
    rng, right, wrong, asked = np.random.default_rng(31), 0, [], 0
    for _ in range(60):
        rig = Rig(rng)
        for sensor in (s for s in rig.sensors if rig.degree(s.name) >= 3):
            found = attribute(rig.shifts({sensor.name: knock(rng, sensor)}, rng))
            asked += 1
            right += found.sensor == sensor.name
            wrong += [found.sensor] if found.sensor not in (sensor.name, None) else []
    assert asked > 200
    assert right / asked >= 0.95
    assert not wrong


@pytest.mark.parametrize("is_hub", [True, False])
def test_a_hub_and_a_leaf_of_one_edge_are_never_taken_for_each_other(is_hub):
    rng = np.random.default_rng(32)
    for _ in range(200):
        rig = Rig(rng, edges=7)  # a star: all but s0 are leaves
        hub, leaf = rig.sensors[0], rig.sensors[int(rng.integers(1, 8))]
        moved, other = (hub, leaf) if is_hub else (leaf, hub)
        found = attribute(rig.shifts({moved.name: knock(rng, moved)}, rng))
        assert found.probability[other.name] < 0.01


def test_a_leaf_and_the_only_sensor_that_it_meets_are_not_told_apart():
    rng = np.random.default_rng(33)
    shifts = Rig(rng, edges=7).shifts({}, rng)
    alone = Edge(Sensor("rear", "camera"), Sensor("tail", "lidar"))
    shifts[alone] = PairShift(exp_se3(rng.normal(size=6)), np.r_[0.01, np.zeros(5)], np.eye(6) * 1e-7)
    found = attribute(shifts)
    assert found.sensor is None
    assert found.explanation == "rear and tail cannot be distinguished"


def test_a_vehicle_frame_that_moved_against_all_sensors_is_told_from_a_reference_that_moved():
    rng, named = np.random.default_rng(34), []
    for _ in range(100):
        rig = Rig(rng, edges=14, with_base=True)
        for name in ("base", "s0"):
            found = attribute(rig.shifts({name: np.array([0, np.radians(0.5), 0, 0, 0, 0])}, rng))
            assert found.sensor in (name, None)
            named.append(found.sensor == name)
    assert np.mean(named) >= 0.95


def test_two_sensors_that_moved_at_once_are_both_named_with_their_motions():
    rng, right, normalised = np.random.default_rng(35), 0, []
    for _ in range(100):
        rig = Rig(rng)
        able = [s for s in rig.sensors if s.kind != "radar" and rig.degree(s.name) >= 2]
        moved = {able[i].name: knock(rng, able[i]) for i in rng.permutation(len(able))[:2]}
        found = attribute(rig.shifts(moved, rng))
        right += set(found.moved) == {*moved}
        for name in {*found.moved} & {*moved}:
            error = found.moved[name].motion - moved[name]
            normalised.append(error @ np.linalg.solve(found.moved[name].covariance, error))
    assert right >= 95
    assert 4.5 < np.mean(normalised) < 7.5
