"""Initial pose: the basin of the camera-lidar score, and whether its evidence leads over all others.

A single search or a single term can be wrong: on a day of another simulator, markings alone moved the camera
12 deg off, against the edges. Candidates therefore come from the prior, from a grid of rotations by all terms
together and by each alone, and from the vehicle's state. Each is optimised with the same kernel within the
search range, and their ends are compared by each term's evidence beyond chance (`beyond_chance`). The best
end is accepted if it leads over the best of all chance poses of the search, if the day rejects every other
end, and if no term with a clear maximum contradicts it. The last test is made over blocks of frames, because
a lidar that does not see paint also has a brightest place somewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.calibrate.joint.camera_lidar.refine import SCHEDULE, AlignmentState, Scored, prior_value, refine
from pipeline.calibrate.joint.camera_lidar.rotation_search import (
    GRID_SHIFTS_PX,
    TERMS,
    Evidence,
    by_chance,
    grid_kernel_rad,
    grid_maxima,
    grid_turns,
    wrong_poses,
)
from pipeline.calibrate.numerics.covariance import CLEARLY, widening
from pipeline.calibrate.reasons import because
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.se3 import inverse, log_so3, transform_points

__all__ = ["MARGIN_RAD", "Basin", "difference", "find_basin", "settled"]

# Ends that move the day's points by less than this (median angle), or by less than three quarters of the kernel at
# which they are compared, are one optimum: sharper kernels pull in as much.
_SAME_OPTIMUM_RAD, _SAME_OPTIMUM_KERNELS = float(np.radians(0.5)), 0.75
_ENDS_THAT_TELL = 2  # of one optimum; the better one counts
_POINTS = 500  # that show how far two ends are apart
# A rival that may not have arrived is optimised so many times more at most, until a time raises it by less than this.
_FINISHES, _HARDLY = 4, 0.5
# A rival no further off is asked again by sharper kernels: they keep the points in view from the best end, and
# this far about it (`estimate`). From further off other points are seen, and what is seen there cannot be compared.
MARGIN_RAD = float(np.radians(2.0))
_SHIFT_SIGMAS = 3.0  # of the prior: how far wrong poses are shifted at most
_CONTRADICTED = (
    0.5  # share of the other terms' lead by which a term must be for another place to contradict an end
)


@dataclass(frozen=True, eq=False)
class Basin:
    """The best end of all candidates, its evidence, and in `doubt` the reason against it (or empty)."""

    state: AlignmentState
    kernel: KernelSettings  # at which ends were compared: the terms weighted alike in units of chance
    origin: str
    candidates: int
    evidence: tuple[float, ...]  # by term, in units of chance
    needed: float  # of all terms together: what the best of all chance poses of the search shows
    rival_rad: (
        float  # how far the best end elsewhere moves the day's points (median angle); pi where there is none
    )
    rival_z: float  # standard errors by which the day's frames reject the ends elsewhere; infinity where there are none
    rival: AlignmentState | None = None  # the end elsewhere that they do not reject; `settled` asks it again
    doubt: str = ""


@dataclass(frozen=True, eq=False)
class _End:
    """End of the optimisation from a candidate, and the terms' evidence there with the common kernel."""

    origin: str
    state: AlignmentState
    evidence: Float[np.ndarray, " 3"]
    by_frame: Float[np.ndarray, " F"]
    prior: float  # log density, up to a constant
    is_finished: bool = False  # optimised further than to compare candidates

    @property
    def total(self) -> float:
        """Evidence of all terms and the prior together."""
        return float(self.evidence.sum()) + self.prior


def find_basin(terms: Terms, scored: Scored, rng: np.random.Generator, block: Int[np.ndarray, " F"]) -> Basin:
    """Optimise candidates until the best end is found, or no candidate is left.

    Args:
        scored: a few sharp points, the kernel with which ends are compared, the prior (centre of the search),
            and the config with the smallest search range.
        rng: decides everything random.
        block: block of each frame; errors of different blocks are independent.
    """
    prior, (reach, shift) = scored.prior, scored.config.search_range(scored.prior.sigmas)
    wrong = wrong_poses(prior, reach, min(shift, _SHIFT_SIGMAS * prior.translation_sigma_m), rng)
    match = np.full_like(scored.kernel.match, SCHEDULE.coarse_match)
    kernel = replace(scored.kernel, match=match)
    compared = scored.terms.at_most(SCHEDULE.compared_points, rng)
    evidence = Evidence(compared, kernel, GRID_SHIFTS_PX).measured(wrong)
    scored = replace(scored, kernel=evidence.weighted())
    search = _Search(scored, evidence, block)
    for origin, start, decides in _candidates(terms, scored, reach, wrong, rng):
        search.climb(origin, start)
        if decides and not (basin := search.conclude()).doubt and basin.rival is None:
            return basin
    return search.conclude(is_last=True)


def settled(basin: Basin, scored: Scored, best: AlignmentState, rival: AlignmentState) -> Basin:
    """The basin after its best end and the rival were optimised with a narrower kernel.

    With the kernel of the search, an end a degree away has a similar score; it now leads to the same pose, or
    is rejected.
    """
    apart = _apart_rad(scored.terms, best, rival)
    lower = np.subtract(*(scored.terms.score(s.alone, scored.kernel)[0] for s in (best, rival)))
    error = float(lower.std(ddof=1)) / np.sqrt(len(lower)) if len(lower) > 1 else np.inf
    z = float(lower.mean()) / error if error > 0 else np.inf
    basin = replace(basin, rival_rad=apart, rival_z=z)
    if basin.doubt or apart < _SAME_OPTIMUM_RAD or z >= CLEARLY:
        return basin
    return replace(basin, doubt=_fits_as_well(basin))


def _fits_as_well(basin: Basin) -> str:
    off = np.degrees(basin.rival_rad)
    return because("other minimum", off=off, origin=basin.origin, z=basin.rival_z)


def difference(a: AlignmentState, b: AlignmentState) -> Float[np.ndarray, " 8"]:
    """Rotation vector, translation, dt and focal scale from b to a."""
    D = a.T_camera_lidar @ inverse(b.T_camera_lidar)
    shift = a.T_camera_lidar[:3, 3] - b.T_camera_lidar[:3, 3]
    return np.concatenate([log_so3(D[:3, :3]), shift, [a.dt_s - b.dt_s, a.focal - b.focal]])


# -- candidates ------------------------------------------------------------------------------------------------------


def _candidates(
    terms: Terms, scored: Scored, reach: float, wrong: np.ndarray, rng: np.random.Generator
) -> Iterator[tuple[str, AlignmentState, bool]]:
    """Starts, their origins, and whether the search may end with them, which requires that each term was searched."""
    prior = scored.prior
    yield "prior", AlignmentState(prior.T_camera_lidar), False
    found = grid_maxima(terms.sharp(), prior, reach, wrong, rng)
    for number, (name, T) in enumerate(found):
        yield name, AlignmentState(T), number >= len(TERMS)
    if prior.T_camera_lidar_before is not None:
        # Last: whether an earlier day was calibrated already must not change a day whose own data decide.
        state = AlignmentState(prior.T_camera_lidar_before)
        yield "state", state.within(prior, scored.config.search_range(prior.sigmas)), True


def _climbed(scored: Scored, start: AlignmentState) -> AlignmentState:
    """End of a start, first with the grid's kernel if that is wider, then with the common kernel."""
    sigma_px = np.radians(SCHEDULE.grid_kernel_deg) * float(scored.terms.camera[1])
    if sigma_px > scored.kernel.sigma_px:
        wider = replace(scored, kernel=replace(scored.kernel, sigma_px=sigma_px))
        start = refine(wider, start, steps=SCHEDULE.wide_climb_steps)
    return refine(scored, start, steps=SCHEDULE.climb_steps)


# -- ends ------------------------------------------------------------------------------------------------------------


class _Search:
    """The ends so far."""

    def __init__(self, scored: Scored, evidence: Evidence, block: Int[np.ndarray, " F"]) -> None:
        self.scored, self.evidence, self.block = scored, evidence, block
        self.ends: list[_End] = []
        kernel_rad = scored.kernel.sigma_px / float(scored.terms.camera[1])
        self.same_rad = max(_SAME_OPTIMUM_RAD, _SAME_OPTIMUM_KERNELS * kernel_rad)
        reach = scored.config.search_range(scored.prior.sigmas).rotation_rad
        self.leads_there_rad = SCHEDULE.grid_step_kernels * grid_kernel_rad(reach)
        self.poses, self.candidates = len(grid_turns(reach)), 0

    def climb(self, origin: str, start: AlignmentState) -> None:
        """Add the end of a candidate, unless it starts where two others ended, and would only repeat them."""
        self.candidates += 1
        near = sum(self._apart(start, e.state) < self.leads_there_rad for e in self.ends)
        if near < _ENDS_THAT_TELL:
            self.ends.append(self._end(origin, _climbed(self.scored, start)))

    def conclude(self, *, is_last: bool = False) -> Basin:
        """The best end, and the reason against it.

        As long as candidates are left, the sum of a term's data suffices as a reason.
        """
        self.ends.sort(key=lambda e: -e.total)
        first = self._finished(self.ends[0])
        # Ends elsewhere that are near, or that the day does not reject, may not have arrived yet.
        self.ends = [first, *(self._arrived(e, first) for e in self.ends[1:])]
        best = max(self.ends, key=lambda e: e.total)
        apart = [(self._apart(e.state, best.state), e) for e in self.ends if e is not best]
        rivals = [e for a, e in apart if a >= self.same_rad]
        rival = min(rivals, key=lambda e: _rejected(best, e), default=None)
        basin = Basin(
            best.state,
            self.scored.kernel,
            best.origin,
            self.candidates,
            tuple(float(x) for x in best.evidence),
            by_chance(self.poses, self.evidence.terms_with_values),
            np.pi if rival is None else self._apart(rival.state, best.state),
            np.inf if rival is None else _rejected(best, rival),
        )
        is_near = rival is not None and basin.rival_z < CLEARLY and basin.rival_rad < MARGIN_RAD
        doubt = self._doubt(basin, rivals, is_last=is_last)
        return replace(basin, rival=rival.state if rival and is_near else None, doubt=doubt)

    def _doubt(self, basin: Basin, rivals: Sequence[_End], *, is_last: bool) -> str:
        """Reason why the best end cannot be accepted."""
        if (total := sum(basin.evidence)) < basin.needed:
            return because("no minimum", origin=basin.origin, total=total, needed=basin.needed)
        if basin.rival_z < CLEARLY and basin.rival_rad >= MARGIN_RAD:
            return _fits_as_well(basin)
        alone = by_chance(self.poses, 1)
        for rival in rivals:
            lead = np.array(basin.evidence) - rival.evidence
            is_ahead = (rival.evidence > alone) & (-lead > _CONTRADICTED * (lead.sum() - lead))
            if is_last and is_ahead.any():
                is_ahead &= self._holds(rival.state, basin.state)
            if is_ahead.any():
                return because("term", term=TERMS[int(np.argmax(is_ahead))], origin=basin.origin)
        return ""

    def _holds(self, there: AlignmentState, here: AlignmentState) -> Bool[np.ndarray, " 3"]:
        """Whether each term's own data prefer `there` to `here`, clearly by the scatter over blocks of frames."""
        of_there, of_here = (self.evidence.by_block(s.alone, self.block) for s in (there, here))
        lead, blocks = of_there - of_here, len(of_here)
        if blocks < 2:
            return np.zeros(len(TERMS), bool)
        error = lead.std(axis=0, ddof=1) / np.sqrt(blocks) * widening(float(blocks))
        return lead.mean(0) > CLEARLY * error

    def _arrived(self, end: _End, best: _End) -> _End:
        apart = self._apart(end.state, best.state)
        # By its frames alone: on its way an end may pay a prior of the focal length that it will not pay in the end.
        is_rival = apart < self.leads_there_rad or _rejected(best, end, with_prior=False) < CLEARLY
        return self._finished(end, _FINISHES) if is_rival and apart >= self.same_rad else end

    def _finished(self, end: _End, times: int = 1) -> _End:
        """The end, optimised further, several times for as long as it rises: a focal length's valley is long."""
        if end.is_finished:
            return end
        for _ in range(times):
            before = end.total
            end = self._end(end.origin, refine(self.scored, end.state, steps=SCHEDULE.finishing_steps))
            if end.total - before < _HARDLY:
                break
        return replace(end, is_finished=True)

    def _end(self, origin: str, state: AlignmentState) -> _End:
        at = state.alone
        prior = float(prior_value(at, self.scored.prior, self.scored.config)[0])
        return _End(origin, state, self.evidence.at(at)[0], self.evidence.by_frame(at), prior)

    def _apart(self, a: AlignmentState, b: AlignmentState) -> float:
        return _apart_rad(self.scored.terms, a, b)


def _rejected(best: _End, other: _End, *, with_prior: bool = True) -> float:
    """Standard errors by which the day rejects an end, from its frames or equivalent to its evidence."""
    lower, lead = best.by_frame - other.by_frame, best.total - other.total
    if not with_prior:
        lead = best.total - best.prior - (other.total - other.prior)
    error = lower.std(ddof=1) / np.sqrt(len(lower)) if len(lower) > 1 else np.inf
    by_scatter = float(lower.mean() / error) if error > 0 else np.inf
    # Of a normal variable with this difference of log likelihoods.
    return max(by_scatter, float(np.sqrt(2 * max(lead, 0.0))))


def _apart_rad(terms: Terms, a: AlignmentState, b: AlignmentState) -> float:
    """Median angle between the day's edges and markings in the image at two poses.

    This is not a distance of poses: a rotation and a shift with the same effect on points are in one valley.
    """
    points = np.concatenate([terms.edges.xyz_m, terms.markings.xyz_m])
    points = points[:: max(1, len(points) // _POINTS)]
    u, v = (_directions(transform_points(s.T_camera_lidar, points)) for s in (a, b))
    return float(np.median(np.arccos(np.clip(np.sum(u * v, axis=1), -1, 1)))) if len(points) else 0.0


def _directions(points: np.ndarray) -> np.ndarray:
    return points / np.linalg.norm(points, axis=1, keepdims=True)
