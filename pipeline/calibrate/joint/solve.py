"""Method `joint`: camera-lidar, then lidar-radar with the camera's help, camera-radar composed of the two.

The hard loop `T_camera_radar = T_camera_lidar T_lidar_radar` leaves 12 unknowns. They are solved one pair after the
other: the camera-lidar terms determine their pose ten times better than any radar term could, so a common last step
would add noise only. Camera-lidar is concluded after lidar-radar: its time offset moves the cloud along the car's way,
whose direction in lidar axes lidar-radar estimates.

So the two pairs rest on each other, and an error of one would be the other's: on a day whose camera-lidar was lost,
boxes read through it put lidar-radar 1.6 deg off. What is not believed in the end is taken out: `Solution.without`
solves again whatever rested on it.

Where a sensor is missing, the pairs of the others are solved without it: camera-lidar along the lidar's own x axis,
lidar-radar without boxes, camera-radar alone by what it is otherwise checked with.

A loop that is closed by construction checks nothing, so estimates that took no part are compared with it: camera-radar
without the lidar, disjoint halves of the day, other origins of the search, and the registration's own roll and pitch
(`failed_checks`). A CameraInfo that the day contradicts holds camera-lidar: with a better one its pose is another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import contradictions
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
from pipeline.calibrate.joint.composition import compose_pairs
from pipeline.calibrate.joint.failed_checks import lidar_radar_failures, unvouched_basin
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.config import SolveConfig
from pipeline.errors import SolveError
from pipeline.extrinsics.checks import FailedCheck
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.results import Progress, silent
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["solve_joint"]

# Sigmas of priors where `terms` leaves time offsets or the position prior out.
_NO_OFFSET_S, _ANYWHERE_M = 1e-4, 10.0


def solve_joint(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    *,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
    """Solve the pairs that have frames.

    Args:
        observations: selected frames per pair; a pair that is left out costs the others its help, no more.
        prior: start and weak prior.
        config: effort.
        seed: decides everything random.
        triggered: pairs to estimate; camera_radar follows from the other two. Others keep the prior.
        progress: told about each pair.

    Returns:
        The solution; a pair that the day cannot determine keeps its prior, with a failed check that says why.
    """
    prior, config = _without_terms(prior, config)
    wanted = set(triggered) | ({"camera_lidar", "lidar_radar"} if "camera_radar" in triggered else set())
    wanted &= observations.keys()
    progress(0, 3, "camera-lidar")
    aligned: Aligned | FailedCheck | None = None
    if "camera_lidar" in wanted:
        try:
            rng = np.random.default_rng([seed, 0])
            aligned = align_camera_lidar(observations["camera_lidar"], prior, config, rng)
        except SolveError as err:
            aligned = FailedCheck(err.reason, err.fault)
    return _Day(observations, prior, config, seed, frozenset(wanted), aligned, progress).solved(frozenset())


@dataclass(frozen=True, eq=False)
class _Day:
    """A day whose camera-lidar is aligned, as far as it can be: from here on the pairs help each other, or may not."""

    observations: Mapping[str, Sequence[Observation]]
    prior: Prior
    config: SolveConfig
    seed: int
    wanted: frozenset[str]
    aligned: Aligned | FailedCheck | None  # or why not; None where nobody asked
    progress: Progress
    # Estimates made before, with the checks that they failed, by pair and what they rest on: solved again is only what
    # rests on a disbelieved pair.
    made: dict[tuple[object, ...], tuple[PairEstimate, list[FailedCheck]]] = field(default_factory=dict)

    def solved(self, disbelieved: frozenset[str]) -> Solution:
        """The solution in which no pair rests on a disbelieved one."""
        self.progress(1, 3, "lidar-radar")
        helped = self._camera_helps(disbelieved)
        headed = "lidar_radar" in self.observations and "lidar_radar" not in disbelieved
        found: dict[str, tuple[PairEstimate, list[FailedCheck]]] = {}
        if "lidar_radar" in self.observations:
            found["lidar_radar"] = self._once(("lidar_radar", helped), lambda: self._lidar_radar(helped))
        if "camera_lidar" in self.observations:
            along = found["lidar_radar"][0] if headed else None
            found["camera_lidar"] = self._once(
                ("camera_lidar", helped, headed), lambda: self._camera_lidar(along)
            )
        self.progress(2, 3, "camera-radar")
        loop_rad = None
        if "camera_radar" in self.observations:
            found["camera_radar"] = self._once(("camera_radar",), self._camera_radar)
            if len(found) == len(PAIRS):
                found["camera_radar"], loop_rad = self._composed(found)
            elif "camera_radar" not in self.wanted:
                found["camera_radar"] = PairEstimate.at_prior("camera_radar", self.prior), []
        self.progress(3, 3, "done")
        pairs = {pair: found[pair][0] for pair in PAIRS if pair in found}
        checks = {pair: found[pair][1] for pair in pairs if found[pair][1]}
        return Solution("joint", pairs, loop_rad, None, checks, self.solved)

    def _once(
        self, key: tuple[object, ...], make: Callable[[], tuple[PairEstimate, list[FailedCheck]]]
    ) -> tuple[PairEstimate, list[FailedCheck]]:
        if key not in self.made:
            self.made[key] = make()
        return self.made[key]

    def _camera_radar(self) -> tuple[PairEstimate, list[FailedCheck]]:
        """Without the lidar: what the composed one is compared with, or the result where there is none."""
        rng = np.random.default_rng([self.seed, 2])
        seen = self.observations["camera_radar"]
        return estimate_camera_radar(seen, self.prior, self.config, rng), []

    def _composed(
        self, found: Mapping[str, tuple[PairEstimate, list[FailedCheck]]]
    ) -> tuple[tuple[PairEstimate, list[FailedCheck]], float | None]:
        """Camera-radar by the loop, with the checks that it and its factors failed; the loop's angle."""
        camera_lidar, camera_failed = found["camera_lidar"]
        lidar_radar, radar_failed = found["lidar_radar"]
        without_lidar, _ = found["camera_radar"]
        camera_radar, loop_rad, contradictions = compose_pairs(
            camera_lidar, lidar_radar, without_lidar, self.prior
        )
        if isinstance(self.aligned, Aligned) and not self.aligned.basin.vouched_by:
            # A lost camera contradicts a lidar-radar that is right: the prior, and its sigma, stand in for it. One that
            # is only unsure is compared with its sigma, like any other.
            camera = PairEstimate.at_prior("camera_lidar", self.prior)
            _, _, contradictions = compose_pairs(camera, lidar_radar, without_lidar, self.prior)
        camera_radar = replace(camera_radar, disproved=camera_lidar.disproved)
        return (camera_radar, [*camera_failed, *radar_failed, *contradictions]), loop_rad

    def _camera_helps(self, disbelieved: frozenset[str]) -> bool:
        """Whether lidar-radar may rest on the camera's alignment: not where nobody vouches for its basin."""
        if not isinstance(self.aligned, Aligned) or "camera_lidar" in disbelieved:
            return False
        return bool(self.aligned.basin.vouched_by)

    def _lidar_radar(self, helped: bool) -> tuple[PairEstimate, list[FailedCheck]]:
        """With the camera's boxes where it may help."""
        prior = self.prior
        if "lidar_radar" not in self.wanted:
            return PairEstimate.at_prior("lidar_radar", prior), []
        # Without an alignment the prior stays current: where that is exact enough, boxes are read through it.
        T = prior.T_camera_lidar if prior.knows("camera_lidar") else None
        covariance = prior.covariance("camera_lidar")
        if helped and isinstance(self.aligned, Aligned):
            T, covariance = self.aligned.T_camera_lidar, self.aligned.covariance
        try:
            found = estimate_lidar_radar(
                self.observations["lidar_radar"],
                prior,
                T,
                self.config,
                np.random.default_rng([self.seed, 1]),
                covariance_camera_lidar=covariance,
            )
        except SolveError as err:
            return PairEstimate.at_prior("lidar_radar", prior), [FailedCheck(err.reason, err.fault)]
        if not helped and "camera_lidar" in self.wanted:
            note = "camera-lidar is not believed: estimated without its help"
            found = replace(found, notes=[*found.notes, note])
        return found, lidar_radar_failures(found)

    def _camera_lidar(self, lidar_radar: PairEstimate | None) -> tuple[PairEstimate, list[FailedCheck]]:
        """Along the heading that lidar-radar shows; None = that is disbelieved."""
        if not isinstance(self.aligned, Aligned):
            return PairEstimate.at_prior("camera_lidar", self.prior), [] if self.aligned is None else [
                self.aligned
            ]
        heading = None if lidar_radar is None else _heading(lidar_radar)
        found = analyse_camera_lidar(self.aligned, np.random.default_rng([self.seed, 3]), heading=heading)
        found = replace(found, disproved=unvouched_basin(self.aligned.basin))
        # Of a basin that is lost, nobody knows what its intrinsics are worth.
        told = [] if found.disproved else contradictions(self.aligned.intrinsics, self.prior.camera)
        return found, [*told, *found.failed_checks]


def _without_terms(prior: Prior, config: SolveConfig) -> tuple[Prior, SolveConfig]:
    """Time offsets fixed to zero, and a prior without position, where `terms` leaves those out."""
    if "time_offsets" not in config.terms:
        config = config.model_copy(update={"time_offset_sigma_s": _NO_OFFSET_S})
    if "translation_prior" not in config.terms:
        prior = replace(prior, translation_sigma_m=_ANYWHERE_M)
    return prior, config


def _heading(lidar_radar: PairEstimate) -> tuple[np.ndarray, float] | None:
    """Radar pose and sigma of its yaw [rad], which give the car's heading in lidar axes; None where yaw is unknown."""
    if not lidar_radar.observable[2]:
        return None
    return lidar_radar.T, float(np.sqrt(lidar_radar.covariance[2, 2]))
