"""Search of camera-lidar over rotations: evidence in units of chance, and an exhaustive grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.joint.camera_lidar.refine import SCHEDULE
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation

__all__ = [
    "GRID_SHIFTS_PX",
    "TERMS",
    "Evidence",
    "by_chance",
    "grid_kernel_rad",
    "grid_maxima",
    "grid_turns",
    "wrong_poses",
]

# --------------------------------------------------------------------------------------------------
# Evidence of each term of the camera-lidar score for a pose, in units of its values at wrong poses.
#
# Edges, markings and classes are sums of log likelihood ratios of points with correlated errors, to a different
# degree for each term. On a day of another simulator, bright paint on bright road scored thousands of nats at
# poses 12 deg off and nothing at the truth. So random poses are drawn, which are nearly always wrong, and each
# term is measured in units of its upper tail over them. A term with a clear maximum exceeds many tails. A term
# without information has no outlier, and cannot dominate the others.


TERMS = ("edges", "markings", "classes")
_POSES = 200  # that show what chance is worth
_LEAST_TURN_RAD = np.radians(15.0)  # half-width of where they are drawn: few of them lie about the truth
_TAIL = 0.9  # quantile beyond which the tail begins
_BATCH = 512  # poses at a time: their rows of 3x4 transforms by frame stay in the cache


def wrong_poses(
    prior: Prior, rotation_rad: float, shift_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "P 4 4"]:
    """Random poses about the prior, with a spread so wide that nearly all of them are wrong."""
    reach = max(rotation_rad, _LEAST_TURN_RAD)
    R = exp_so3(rng.uniform(-reach, reach, (_POSES, 3))) @ prior.T_camera_lidar[:3, :3]
    t = prior.T_camera_lidar[:3, 3] + rng.uniform(-shift_m, shift_m, (_POSES, 3))
    return from_rotation_translation(R, t)


def by_chance(poses: int, terms: int) -> float:
    """Combined evidence of `terms` at the best of so many wrong poses; tails are exponential.

    A sum of `terms` exponentials exceeds x with probability e^-x (1 + x + .. + x^(terms-1) / (terms-1)!).
    """
    x = np.linspace(0.0, 100.0, 5001)
    series = sum(x**k / math.factorial(k) for k in range(max(terms, 1)))
    return float(x[np.argmax(np.log(poses * series) < x)])


@dataclass(frozen=True, eq=False)
class Evidence:
    """The terms of a day at one kernel, each in units of chance.

    Without `shifts_px` an edge counts its score beyond `per_edge`, the median wrong pose's edges: cheaper,
    and less certain if images differ from place to place.
    """

    terms: Terms
    kernel: KernelSettings
    shifts_px: Sequence[tuple[float, float]] = ()
    per_edge: float = 0.0
    middle: tuple[float, ...] = (0.0, 0.0, 0.0)
    tail: tuple[float, ...] = (1.0, 1.0, 1.0)

    def measured(self, wrong: Float[np.ndarray, "P 4 4"]) -> Evidence:
        """The evidence with the tail of each term at wrong poses; a term without values has no tail."""
        raw = self if self.shifts_px else replace(self, per_edge=self._median_edge(wrong))
        shown = raw.of(wrong)
        begin = np.quantile(shown, _TAIL, axis=0)
        beyond = np.maximum(shown - begin, 0.0)
        tail = beyond.sum(0) / np.maximum((beyond > 0).sum(0), 1)
        return replace(raw, middle=tuple(np.median(shown, axis=0)), tail=tuple(tail))

    @property
    def terms_with_values(self) -> int:
        """Number of terms that the day shows: classes need labels, markings need reflectivity."""
        return int(np.count_nonzero(np.asarray(self.tail) > 0))

    def weighted(self) -> KernelSettings:
        """The kernel with equal weights of edges and markings in units of chance; the larger weight is 1."""
        weight = np.array([1 / t if t > 0 else 0.0 for t in self.tail[:2]])
        edges, markings = weight / max(weight.max(), 1e-12)
        return replace(self.kernel, edge_weight=float(edges), marking_weight=float(markings))

    def of(self, poses: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P 3"]:
        """Evidence for poses by term, with the logged clock."""
        return np.concatenate([self.at(at) for at in _batches(poses)])

    def at(self, at: Alignments) -> Float[np.ndarray, "P 3"]:
        """Evidence for alignments by term."""
        edges, markings = (x.sum(1) for x in self._excess(at))
        if self.per_edge:
            edges = edges - self.per_edge * self.terms.edges_in_view(at)
        shown = np.column_stack([edges, markings, self.terms.class_information(at)])
        return _in_tails(shown - self.middle, self.tail)

    def by_frame(self, at: Alignments) -> Float[np.ndarray, " F"]:
        """Evidence of edges and markings together for each frame at ONE alignment, up to a constant."""
        return _in_tails(np.stack([x[0] for x in self._excess(at)], -1), self.tail[:2]).sum(1)

    def by_block(self, at: Alignments, block: Int[np.ndarray, " F"]) -> Float[np.ndarray, "B 3"]:
        """Evidence of each block of frames for each term at ONE alignment, up to a constant."""
        edges, markings = (x[0] for x in self._excess(at))
        shown = []
        for name in np.unique(block):
            rows = np.flatnonzero(block == name)
            classes = self.terms.of_frames(rows).class_information(at)[0]
            shown.append([edges[rows].sum(), markings[rows].sum(), classes])
        return _in_tails(np.array(shown), self.tail)

    def _excess(self, at: Alignments) -> tuple[np.ndarray, np.ndarray]:
        how = (at, self.kernel, self.shifts_px)
        beyond = self.terms.beyond_chance
        return beyond(Terms.edge_score, *how), beyond(Terms.marking_score, *how)

    def _median_edge(self, wrong: Float[np.ndarray, "P 4 4"]) -> float:
        at = _batches(wrong)
        score = np.concatenate([self.terms.edge_score(a, self.kernel).sum(1) for a in at])
        count = np.concatenate([self.terms.edges_in_view(a) for a in at])
        return float(np.median(score[count > 0] / count[count > 0])) if (count > 0).any() else 0.0


def _in_tails(shown: np.ndarray, tail: Sequence[float]) -> np.ndarray:
    return shown * np.array([1 / t if t > 0 else 0.0 for t in tail])


def _batches(poses: Float[np.ndarray, "P 4 4"]) -> list[Alignments]:
    parts = [poses[i : i + _BATCH] for i in range(0, len(poses), _BATCH)]
    return [Alignments(p, np.zeros(len(p)), np.ones(len(p))) for p in parts]


# --------------------------------------------------------------------------------------------------
# Exhaustive search over rotations: edges, markings and classes on a grid of rotations about a pose.
#
# Scores with a narrow kernel have many maxima, scores with a wide one are biased. With a kernel of half a
# degree, the score at the truth is well above all others. Over rotations alone, a grid of this resolution is
# affordable: some thousands of poses at a few nanoseconds per point. Shifts within the prior's sigma move most
# points by less than the kernel. A few points select the poses that are scored with all points.
#
# Source: OpenCalib's CalibAnything (Luo et al. 2023) searches rotations by brute force too.


# By so much the image is shifted to see what the same points show by chance: fewer than for the ends of the search.
GRID_SHIFTS_PX = ((-43.0, -37.0), (-31.0, 41.0), (29.0, -31.0), (43.0, 37.0))
TOGETHER = "all terms"


def grid_maxima(
    terms: Terms,
    prior: Prior,
    reach_rad: float,
    wrong: Float[np.ndarray, "P 4 4"],
    rng: np.random.Generator,
) -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Local maxima of a grid of rotations about the camera's axes, with the terms for which they are maxima.

    The order is: the best by all terms together, then each term's best, then others by all terms. The prior
    is the centre of the grid and keeps its translation; `wrong` are poses for the values of chance.
    """
    kernel_rad = grid_kernel_rad(reach_rad)
    kernel = KernelSettings.wide(kernel_rad * float(terms.camera[1]), 0, match=SCHEDULE.coarse_match)
    turns = grid_turns(reach_rad)
    rotations = exp_so3(turns) @ prior.T_camera_lidar[:3, :3]
    shifts = np.broadcast_to(prior.T_camera_lidar[:3, 3], (len(turns), 3))
    poses = from_rotation_translation(rotations, shifts)
    likely = -0.5 * ((turns / prior.rotation_sigma_rad) ** 2).sum(1)
    every = np.arange(0, terms.frames, -(-terms.frames // SCHEDULE.grid_frames))
    few = terms.of_frames(every).at_most(SCHEDULE.grid_points, rng)
    rough = Evidence(few, kernel).measured(wrong).of(poses)
    chosen = _highest(rough, likely)
    shown = Evidence(terms.at_most(SCHEDULE.chosen_points, rng), kernel, GRID_SHIFTS_PX).measured(wrong)
    evidence = shown.of(poses[chosen])
    apart_rad = SCHEDULE.grid_apart_kernels * kernel_rad
    best = _separate(turns[chosen], evidence.sum(1) + likely[chosen], apart_rad, SCHEDULE.grid_maxima)
    alone = [(name, int(np.argmax(evidence[:, k]))) for k, name in enumerate(TERMS)]
    found = [(TOGETHER, best[0]), *alone, *((TOGETHER, i) for i in best[1:])]
    return [(name, poses[chosen[i]]) for name, i in found]


def grid_kernel_rad(reach_rad: float) -> float:
    """Width of the kernel; a wider search range has a wider kernel."""
    is_wide = reach_rad > np.radians(SCHEDULE.wide_box_deg)
    return float(np.radians(SCHEDULE.wide_grid_kernel_deg if is_wide else SCHEDULE.grid_kernel_deg))


def grid_turns(reach_rad: float) -> Float[np.ndarray, "P 3"]:
    """Rotation vectors on a grid; roll moves points half as much as the others, so its step is twice as wide."""
    step = SCHEDULE.grid_step_kernels * grid_kernel_rad(reach_rad)
    steps = np.array([step, step, 2 * step])
    count = np.ceil(reach_rad / steps).astype(int)
    axes = [np.linspace(-reach_rad, reach_rad, 2 * n + 1) for n in count]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _highest(evidence: Float[np.ndarray, "P 3"], likely: Float[np.ndarray, " P"]) -> np.ndarray:
    """Indices of the poses to score with all points: highest by all terms together, and by each alone."""
    some, few = (-min(n, len(evidence)) for n in SCHEDULE.grid_chosen)
    by_term = [np.argsort(evidence[:, k])[few:] for k in range(len(TERMS))]
    return np.unique(np.concatenate([np.argsort(evidence.sum(1) + likely)[some:], *by_term]))


def _separate(
    turns: Float[np.ndarray, "P 3"], score: Float[np.ndarray, " P"], apart_rad: float, most: int
) -> list[int]:
    """Indices of the highest scores with a minimum distance from each other."""
    score = score.copy()
    found = []
    for _ in range(most):
        i = int(np.argmax(score))
        if not np.isfinite(score[i]):
            break
        found.append(i)
        score[np.linalg.norm(turns - turns[i], axis=1) < apart_rad] = -np.inf
    return found
