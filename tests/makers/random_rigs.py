"""Random rigs of eight sensors: two lidars, cameras and radars, and how their edges shift where a sensor moved."""

import contextlib

import numpy as np

from pipeline.rig.attribution import PairShift
from pipeline.rig.graph import BASE, Sensor, edge_between
from pipeline.rig.se3 import adjoint, exp_se3, from_rotation_translation, inverse

__all__ = ["SHIFT_SIGMAS", "UNSURE_DEG", "UNSURE_M", "Rig", "knock"]

# Sigmas of an edge's shift between the days before a change and those after it, in its parent's axes [deg, m]: what
# some days of each kind of edge give. What a kind does not show is as unsure as a prior.
UNSURE_DEG, UNSURE_M = 2.0, 0.1
SHIFT_SIGMAS = {
    "camera_lidar": ([0.03, 0.03, 0.05], [0.03, 0.03, 0.05]),
    "camera_radar": ([0.3, 0.08, UNSURE_DEG], [UNSURE_M] * 3),
    "lidar_radar": ([UNSURE_DEG, 0.4, 0.05], [UNSURE_M] * 3),
    "lidar_lidar": ([0.03, 0.03, 0.03], [0.02, 0.02, 0.02]),
    "lidar_base": ([0.05, 0.05, 0.1], [UNSURE_M, UNSURE_M, 0.02]),
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
                with contextlib.suppress(ValueError):  # two cameras, two radars, a camera and base
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
