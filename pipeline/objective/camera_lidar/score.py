"""The camera-lidar terms of method `joint`, prepared from observations and evaluated for many poses at once.

Source: evidence of this project on simulated and real logs: directed edges, reflectivity on the road,
    camera time offset.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.objective.camera_lidar.edges import (
    chance_of,
    edge_gradients,
    edge_residuals,
    edge_scores,
    fit_match_share,
)
from pipeline.objective.camera_lidar.image_maps import CONTRAST_STEP, CameraMaps, Start, prepare_maps
from pipeline.objective.camera_lidar.kernel_settings import MAX_GAP_PX, WIDEST_GAP_RAD, KernelSettings
from pipeline.objective.camera_lidar.points import (
    CLASSES,
    EDGE_KINDS,
    Points,
    exposed,
    gathered,
    is_near_view,
    motion_in_camera,
    moving_poses,
    view_bounds,
)
from pipeline.objective.camera_lidar.projection_loops import camera_parameters, count_in_view
from pipeline.objective.camera_lidar.readings import class_information, marking_gradients, marking_scores
from pipeline.objective.stamp_gaps import gaps_s
from schemas.observations import EDGE_ABOVE, Observation

__all__ = ["CONTRAST_BLURS_PX", "Alignments", "KernelSettings", "Start", "Terms", "prepare_terms"]

CONTRAST_BLURS_PX = (6.0, 3.0, 1.5)
# Shifts of the image [label px] that give the chance score of the same points.
_SHIFTS_PX = tuple((u, v) for u in (-47.0, -31.0, 29.0, 43.0) for v in (-37.0, 0.0, 41.0))
_CHANCE_SHIFT_PX = 60.0  # far enough to be elsewhere, near enough to see the same scene


@dataclass(frozen=True, eq=False)
class Alignments:
    """P candidates: poses, camera time offsets, focal lengths in units of the camera's."""

    T_camera_lidar: np.ndarray
    dt_s: np.ndarray
    focal: np.ndarray


@dataclass(frozen=True, eq=False)
class Terms:
    """Everything that the camera-lidar score of F frames needs."""

    maps: CameraMaps
    camera: np.ndarray
    edges: Points
    markings: Points
    classes: Points  # sampled cloud by height and range, for the basin
    velocity_lidar: np.ndarray  # F 3, own velocity in lidar axes [m/s]
    yaw_rate: np.ndarray  # F [rad/s]
    gap_s: np.ndarray  # F, image stamp minus lidar stamp
    readout_s: float = 0.0  # of a rolling shutter, from the first row to the last
    label_offset_px: tuple[float, float] = (0.0, 0.0)  # from the labels to the picture, which has the paint

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.velocity_lidar)

    @cached_property
    def _label_camera(self) -> np.ndarray:
        """The camera that projects into the labels."""
        camera = self.camera.copy()
        camera[3:5] -= np.array(self.label_offset_px, np.float32)
        return camera

    @cached_property
    def _is_wide(self) -> np.ndarray:
        return self.edges.gap_rad * self.camera[1] > MAX_GAP_PX

    @cached_property
    def narrow(self) -> Terms:
        """With edges alone that localise a silhouette within MAX_GAP_PX."""
        return self.sharp().of_kinds(edges=True, markings=False)

    @cached_property
    def wide(self) -> Terms:
        """With the other edges alone."""
        return replace(self, edges=self.edges.chosen(self._is_wide)).of_kinds(edges=True, markings=False)

    def of_kinds(self, *, edges: bool, markings: bool) -> Terms:
        """With or without edges, and markings."""
        kept = [
            p if wanted else p.chosen(np.zeros(len(p.xyz_m), bool))
            for p, wanted in ((self.edges, edges), (self.markings, markings))
        ]
        return replace(self, edges=kept[0], markings=kept[1])

    def sharp(self) -> Terms:
        """Without the edges whose interval is wider than MAX_GAP_PX."""
        return replace(self, edges=self.edges.chosen(~self._is_wide))

    def telling(self) -> Terms:
        """Without wide edges, unless most edges between rows are wide: then only they determine pitch.

        Edges wider than WIDEST_GAP_RAD are always left out.
        """
        between = self.edges.side >= EDGE_ABOVE
        mostly_wide = 2 * np.count_nonzero(between & self._is_wide) > np.count_nonzero(between)
        if not mostly_wide:
            return self.sharp()
        return replace(self, edges=self.edges.chosen(self.edges.gap_rad <= WIDEST_GAP_RAD))

    def in_view(self, T_camera_lidar: Float[np.ndarray, "4 4"], margin_rad: float) -> Terms:
        """The terms with only the edges and markings that a pose puts into the image, or within a margin of it."""
        bounds = view_bounds(self.maps.camera)
        edges, markings = (
            p.chosen(is_near_view(p.xyz_m, T_camera_lidar, bounds, margin_rad))
            for p in (self.edges, self.markings)
        )
        return replace(self, edges=edges, markings=markings)

    def seen_throughout(self, at: Alignments) -> Terms:
        """The terms with only those edges that are in the image at every one of these alignments.

        An edge out of view scores 0. An edge in view scores more on average, even if the match is wrong:
        rails match anywhere along them. A score over edges that come into sight would therefore be drawn to
        poses with more edges.
        """
        still = np.zeros((len(self.edges.xyz_m), 2), np.float32)
        is_seen = np.ones(len(still), bool)
        for poses, focal in zip(self.poses(at), at.focal.astype(np.float32), strict=True):
            residual = edge_residuals(self._label_camera, self.maps.offsets, self.edges, poses, focal, still)
            is_seen &= ~np.isnan(residual)
        return replace(self, edges=self.edges.chosen(is_seen))

    def at_most(self, points: int, rng: np.random.Generator) -> Terms:
        """The terms with at most about `points` of each: narrow edges, wide edges, markings, points of classes."""
        kept = []
        for p, is_wide in ((self.edges, self._is_wide), (self.markings, None), (self.classes, None)):
            group = np.zeros(len(p.xyz_m), np.intp) if is_wide is None else is_wide.astype(np.intp)
            share = np.minimum(1.0, points / np.maximum(np.bincount(group, minlength=1), 1))
            kept.append(p if share.min() >= 1.0 else p.chosen(rng.random(len(p.xyz_m)) < share[group]))
        return replace(self, edges=kept[0], markings=kept[1], classes=kept[2])

    def of_frames(self, frames: np.ndarray) -> Terms:
        """The terms of a selection of the frames; maps are shared."""
        points = {name: getattr(self, name).of_frames(frames) for name in ("edges", "markings", "classes")}
        rows = {name: getattr(self, name)[frames] for name in ("velocity_lidar", "yaw_rate", "gap_s")}
        return replace(self, **points, **rows)

    def exposed_at(self, at: Alignments, velocity_lidar: Float[np.ndarray, "F 3"] | None = None) -> Terms:
        """With points where their image rows saw them at ONE alignment; maybe with other velocities from then on."""
        velocity = self.velocity_lidar if velocity_lidar is None else velocity_lidar
        if self.readout_s == 0:
            return replace(self, velocity_lidar=velocity)
        moved = self
        # With other velocities: back to the middle row by the old ones first.
        for speed, readout_s in ((self.velocity_lidar, 0.0), (velocity, self.readout_s)):
            moved = replace(moved, velocity_lidar=speed)
            about = (moved.poses(at)[0], self.maps.camera, speed, self.yaw_rate, readout_s)
            edges, markings, classes = (
                exposed(p, *about) for p in (moved.edges, moved.markings, moved.classes)
            )
            moved = replace(moved, edges=edges, markings=markings, classes=classes)
        return moved

    def poses(self, at: Alignments) -> Float32[np.ndarray, "P F 12"]:
        """Rows of the transform from each frame's lidar points to its image [P, F, 12].

        By the lidar's clock the image was taken dt before its stamp (stamp_camera = stamp_lidar + dt), which
        is the frame's gap after the sweep's. The image was taken tau = dt - gap earlier, when static points
        were farther ahead by tau times the own velocity: p' = Rz(yaw_rate tau) (p + v tau).
        """
        R, t = at.T_camera_lidar[:, :3, :3], at.T_camera_lidar[:, :3, 3]
        return moving_poses(R, t, at.dt_s, self.gap_s, self.velocity_lidar, self.yaw_rate)

    def edge_score(self, at: Alignments, settings: KernelSettings) -> Float32[np.ndarray, "P F"]:
        """Log likelihood ratio of the edges, wide ones weighted by the settings."""
        focal, poses = at.focal.astype(np.float32), self.poses(at)
        score = np.zeros((len(at.dt_s), self.frames), np.float32)
        for edges, weight in self._weighted_edges(settings):
            found = edge_scores(self._label_camera, self.maps.offsets, edges, poses, focal, settings)
            score += np.float32(weight) * found
        return score

    def _weighted_edges(self, settings: KernelSettings) -> tuple[tuple[Points, float], ...]:
        """Edges, and their weight in the edges' score."""
        if settings.wide_share == 1.0 or not self._is_wide.any():
            return ((self.edges, 1.0),)
        return (self.narrow.edges, 1.0), (self.wide.edges, settings.wide_share)

    def edges_in_view(self, at: Alignments) -> Int64[np.ndarray, " P"]:
        """How many edges each alignment puts into the image (at the logged focal length)."""
        height, width = self.maps.offsets.shape[2:]
        xyz = np.ascontiguousarray(self.edges.xyz_m.T)
        return count_in_view(self.camera, xyz, self.edges.start, self.poses(at), width, height)

    def beyond_chance(
        self,
        score: Callable[[Terms, Alignments, KernelSettings], np.ndarray],
        at: Alignments,
        settings: KernelSettings,
        shifts_px: Sequence[tuple[float, float]] = _SHIFTS_PX,
    ) -> Float[np.ndarray, "P F"]:
        """Score minus that of the same points in shifted images: 0 for a pose that matches by chance.

        This makes poses comparable that see different numbers of edges: turning edges out of view gains
        nothing, nor does laying markings onto a bright stretch of road.

        Args:
            score: `Terms.edge_score` or `Terms.marking_score`.
            at: the alignments.
            settings: kernel of the score.
            shifts_px: of the image (right, down).
        """
        shifted = np.zeros((len(at.dt_s), self.frames))
        for u, v in shifts_px:
            camera = self.camera.copy()
            camera[3:5] += np.float32(u), np.float32(v)
            shifted += score(replace(self, camera=camera), at, settings)
        return score(self, at, settings) - shifted / max(len(shifts_px), 1)

    def marking_score(self, at: Alignments, settings: KernelSettings) -> Float32[np.ndarray, "P F"]:
        """Unweighted log likelihood ratio of the markings."""
        m, contrast = self.markings, self.maps.contrast[settings.contrast_level]
        focal = at.focal.astype(np.float32)
        return marking_scores(
            self.camera, contrast, m.xyz_m, _weights(m, settings), m.start, m.image, self.poses(at), focal
        )

    def class_information(self, at: Alignments) -> Float[np.ndarray, " P"]:
        """Mutual information of lidar class and label, nats per point; for the basin only."""
        c = self.classes
        return class_information(
            self._label_camera, self.maps.labels, c.xyz_m, c.kind, c.start, c.image, self.poses(at), CLASSES
        )

    def score(self, at: Alignments, settings: KernelSettings) -> Float[np.ndarray, "P F"]:
        """Score of each frame at each alignment; higher is better."""
        score = np.zeros((len(at.dt_s), self.frames))
        if settings.edge_weight > 0:
            score += settings.edge_weight * self.edge_score(at, settings)
        if settings.marking_weight > 0:
            score += settings.marking_weight * self.marking_score(at, settings)
        return score

    def gradient(
        self, at: Alignments, settings: KernelSettings
    ) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
        """Gradient of each frame's score at ONE alignment, and its information (positive semidefinite).

        By left perturbation of T_camera_lidar, time offset, focal scale.
        """
        gradient, information = self.camera_gradient(at, settings)
        return gradient[:, :8], information[:, :8, :8]

    def camera_gradient(
        self, at: Alignments, settings: KernelSettings
    ) -> tuple[Float[np.ndarray, "F 11"], Float[np.ndarray, "F 11 11"]]:
        """As `gradient`, and by principal point (right, down) [px of the label image] and readout time [s]."""
        poses = self.poses(at)[0].astype(np.float64)
        motion = motion_in_camera(poses, at.T_camera_lidar[0, :3, 3], self.velocity_lidar, self.yaw_rate)
        focal, m = float(at.focal[0]), self.markings
        gradient, information = np.zeros((self.frames, 11)), np.zeros((self.frames, 11, 11))
        if settings.edge_weight > 0:
            for edges, weight in self._weighted_edges(settings):
                g, H = edge_gradients(
                    self._label_camera, self.maps.offsets, edges, poses, focal, motion, settings
                )
                gradient += settings.edge_weight * weight * g
                information += settings.edge_weight * weight * H
        if settings.marking_weight > 0:
            contrast = self.maps.contrast[settings.contrast_level]
            g, H = marking_gradients(
                self.camera, contrast, m.xyz_m, _weights(m, settings), m.start, m.image, poses, focal, motion
            )
            gradient += settings.marking_weight * g
            information += settings.marking_weight * H
        return gradient, information

    def mean_match(self, settings: KernelSettings) -> Float[np.ndarray, " 4"]:
        """Share of matching edges, mean over the directions with edges."""
        share = settings.match[self.edges.kind]
        counts = np.bincount(self.edges.side, minlength=4)
        return np.bincount(self.edges.side, share, minlength=4) / np.maximum(counts, 1)

    def fitted(self, at: Alignments, settings: KernelSettings, rng: np.random.Generator) -> KernelSettings:
        """The settings with the mixture shares, chance densities and contrast that the data shows at ONE alignment."""
        poses, focal = self.poses(at)[0], np.float32(at.focal[0])
        e, m, offsets = self.edges, self.markings, self.maps.offsets
        still = np.zeros((len(e.xyz_m), 2), np.float32)
        elsewhere = rng.uniform(-_CHANCE_SHIFT_PX, _CHANCE_SHIFT_PX, still.shape).astype(np.float32)
        at_chance = edge_residuals(self._label_camera, offsets, e, poses, focal, elsewhere)
        here = edge_residuals(self._label_camera, offsets, e, poses, focal, still)
        chance = chance_of(at_chance, e.kind, EDGE_KINDS)
        sigma = np.hypot(settings.sigma_px, e.gap_rad * self.camera[1] / np.sqrt(12))
        match = fit_match_share(here, e.kind, sigma, chance)
        unit = replace(settings, delta=1.0)
        delta = float(np.clip(self.marking_score(at, unit).sum() / max(len(m.xyz_m), 1), 0.0, 1.0))
        return replace(settings, match=match, chance=chance, delta=delta)


def _weights(markings: Points, settings: KernelSettings) -> np.ndarray:
    return np.full(len(markings.xyz_m), settings.delta * CONTRAST_STEP, np.float32)


def prepare_terms(
    observations: Sequence[Observation], T_camera_lidar: Float[np.ndarray, "4 4"],
    velocity_lidar: Float[np.ndarray, "F 3"], *, reach_rad: float, readout_s: float = 0.0,
    start: Start | None = None,
) -> Terms:  # fmt: skip
    """Decode maps and gather the points that can come into view within `reach_rad` of a pose.

    `readout_s` is the rolling shutter's, from the first image row to the last; `Terms.exposed_at` brings it
    to bear. Without labels, `start` decides where paint is looked for; None = anywhere within reach of the pose.
    """
    start = Start(T_camera_lidar, reach_rad) if start is None else start
    maps = prepare_maps(observations, CONTRAST_BLURS_PX, start)
    yaw_rate = np.array([o.ego_yaw_rate_radps or 0.0 for o in observations])
    gap_s, at_px = gaps_s(observations, "camera"), observations[0].label_offset_px
    points = gathered(observations, T_camera_lidar, maps.camera, reach_rad)
    return Terms(
        maps, camera_parameters(maps.camera), *points, velocity_lidar, yaw_rate, gap_s, readout_s, at_px
    )
