"""A vehicle-day by networks: iterate the guess on pilot frames, then fit each pair to the evidence of all frames.

Camera-radar is then the product of the fits. Networks without evidence, and those of camera-radar alone, are asked
about all frames near the guess, and their answers are averaged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.learn.infer.aggregate import (
    BIAS_SIGMA,
    OBSERVABLE,
    Answers,
    day_estimate,
    mean_answer,
    twists_about,
)
from pipeline.learn.infer.joint_day import Evidence, Expected, JointDay, fitted_day, likelihood
from pipeline.learn.sample.clouds import own_velocity
from pipeline.learn.sample.frame_sample import SampleRejectedError
from pipeline.objective.stamp_gaps import expected_dt_s, gaps_s
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution
from pipeline.rig.se3 import adjoint, compose_covariance, exp_se3, inverse, log_se3, rotation_angle_rad
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["FrameAnswer", "FrameNetwork", "FrameSource", "single_frame_solution", "solve_by_networks"]

# Guesses are scattered by this much (standard deviation per axis): several times the scatter of one frame's answers.
_SCATTER_RAD, _SCATTER_M = np.radians(0.4), 0.03
_PILOT_FRAMES = 24  # on which the guess is iterated before all frames are used
_PILOT_ROUNDS, _CONVERGED_RAD = 3, np.radians(0.3)
_MIN_FRAMES, _MAX_FRAMES = 8, 160
_BLOCKS = 8  # of the bootstrap, at least
_GUESSES_OF_ONE_FRAME, _FEWEST_GUESSES = 16, 8  # a regression on fewer answers has no scatter
_STARTS_OF_ONE_FRAME, _SEARCH_ROUNDS = 12, 2  # as many passes as pilot frames take, spread over the prior
_HALVES_SIGMAS = 4.0  # beyond it two halves of a day disagree
# Degrees of freedom that need elevations: unobservable with a radar that measures none.
_BY_ELEVATION = {
    "camera_lidar": np.zeros(6, bool),
    "camera_radar": np.array([1, 0, 1, 0, 1, 0], bool),
    "lidar_radar": np.array([1, 1, 0, 0, 0, 1], bool),
}


# Pairs that are fitted to all frames at once: the sensor whose stamps are compared with the sweep's, and 1 where it is
# the parent, -1 where the child (time offsets are parent less child).
_FITTED = {"camera_lidar": ("camera", 1.0), "lidar_radar": ("radar", -1.0)}

# frames(indices) yields the frames of a day with these frame_index, in order.
FrameSource = Callable[[Sequence[int]], Iterator[Frame]]


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """A network's answer to one frame and guess, for the pairs that it estimates."""

    T: Mapping[str, np.ndarray]
    variance: Mapping[str, np.ndarray]  # of a twist on the left [rad^2, m^2]


@runtime_checkable
class FrameNetwork(Protocol):
    """A network as a vehicle-day uses it."""

    @property
    def pairs(self) -> tuple[str, ...]:
        """Pairs that it estimates."""
        ...

    @property
    def composed(self) -> bool:
        """True if camera_radar is the product of the other two pairs before its correction."""
        ...

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """By pair, sigma of the bias that all answers share (see `aggregate`); a pair is missing where unknown."""
        ...

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> Any:
        """Inputs of `answer` from a frame; raises SampleRejectedError if it shows too little."""
        ...

    def evidence(self, pair: str, sensors: Any, T_camera_lidar: np.ndarray) -> Evidence | None:
        """Matching evidence of a pair, lidar points chosen at a guess; None if the network has none of any frame."""
        ...

    def answer(self, sensors: Any, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms from one frame, started at a guess for every pair."""
        ...


def solve_by_networks(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, *, networks: Sequence[FrameNetwork],
    frames: FrameSource, method: str, seed: int, clock_sigma_s: float, triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:  # fmt: skip
    """Estimate all triggered pairs; the others keep the prior.

    Args:
        observations: selected frames per pair; each is used for all pairs.
        networks: together they estimate each pair once.
        clock_sigma_s: of the camera's clock against the lidar's, where the prior does not state it.

    Raises:
        SolveError: too few frames can be shown to the networks.
    """
    rng = np.random.default_rng([seed, 7])
    asked, rejected = _asked_frames(observations, prior, networks, frames, progress)
    centre, candidates = _pilot_centre(asked, rng)
    together: dict[str, JointDay] = {}
    for pair in _FITTED:
        day = _fitted_together(asked, pair, candidates[pair], centre["camera_lidar"], clock_sigma_s)
        if day is not None:
            together[pair], centre[pair] = day, day.fit.T
    is_product = asked.composed and len(together) == len(_FITTED)
    found = {} if is_product else _ask_all(asked, centre, rng, progress)

    def estimate(pair: str, rows: np.ndarray | None = None) -> PairEstimate:
        if pair in together:
            return together[pair].estimate(rows)
        if is_product:
            return _product(estimate("camera_lidar"), estimate("lidar_radar"), prior)
        answers = found[pair]
        if rows is not None:
            kept = {name: getattr(answers, name)[rows] for name in ("guess", "answer", "variance", "block")}
            answers = replace(answers, **kept, frames=max(1, round(answers.frames * float(rows.mean()))))
        return _estimate(pair, answers, asked, rng)

    estimates = {
        pair: replace(estimate(pair), frames_rejected=dict(rejected))
        if pair in triggered
        else PairEstimate.at_prior(pair, prior)
        for pair in PAIRS
    }
    failed: dict[str, list[Check]] = {}
    for pair in _FITTED if is_product else triggered:
        own = together[pair].failed if pair in together else []
        failed[pair] = _halves_disagree(pair, asked.block, estimate) + own
    if is_product:
        failed["camera_radar"] = [check for pair in _FITTED for check in failed[pair]]
        failed = {pair: failed[pair] for pair in triggered}
    if asked.composed or len(triggered) < len(PAIRS):
        # A loop that closes by construction is no evidence.
        return Solution(method, estimates, failed_checks=failed)
    loop = estimates["camera_lidar"].T @ estimates["lidar_radar"].T @ inverse(estimates["camera_radar"].T)
    translation_m = float(np.linalg.norm(loop[:3, 3]))
    return Solution(method, estimates, float(rotation_angle_rad(loop)), translation_m, failed)


def single_frame_solution(
    frame: Frame, observation: Observation, prior: Prior, *, networks: Sequence[FrameNetwork], method: str,
    seed: int,
) -> Solution:  # fmt: skip
    """Solution from one frame: its answers at many guesses, with at least the predicted variance.

    Raises:
        SolveError: the network rejects the frame.
    """
    try:
        sensors = [n.sensors(frame, observation, prior) for n in networks]
    except SampleRejectedError as rejection:
        raise SolveError(f"frame {frame.frame_index}: {rejection.reason.value}") from rejection
    asked = _Asked(networks, prior, [sensors], [observation])
    rng = np.random.default_rng([seed, 7])
    centre, ends, worth = _searched(asked, rng)
    found = _ask(asked, [0] * _GUESSES_OF_ONE_FRAME, centre, rng, lambda _: None)
    estimates = {}
    for pair, own in found.items():
        told = replace(own, ends=twists_about(centre[pair], ends[pair]), ends_worth=worth[pair])
        estimates[pair] = _estimate(pair, told, asked, rng)
    if not estimates["camera_lidar"].observable.any():
        # The picture does not determine it, so nor the radar's pose.
        estimates["camera_radar"] = PairEstimate.at_prior("camera_radar", prior)
    return Solution(method, estimates)


def _searched(
    asked: _Asked, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Ends of searches from starts all over the prior on one frame: by pair the centre, each end, and its worth.

    Only far starts show that a frame fits in several places: near ones all end in the same place. But some of them end
    where nothing fits, which the network's evidence shows.
    """
    prior = asked.prior
    starts = _scattered(_STARTS_OF_ONE_FRAME, rng, prior.rotation_sigma_rad, prior.translation_sigma_m)
    guess = {pair: prior.of(pair) for pair in PAIRS}
    ends: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    for offsets in starts:
        at = _guess(guess, offsets, composed=asked.composed)
        for _ in range(_SEARCH_ROUNDS):
            for network, sensors in zip(asked.networks, asked.sensors[0], strict=True):
                at |= network.answer(sensors, at).T
        for pair in PAIRS:
            ends[pair].append(at[pair])
    stacked = {pair: np.stack(own) for pair, own in ends.items()}
    centre = {
        p: exp_se3(np.median(twists_about(prior.of(p), T), axis=0)) @ prior.of(p) for p, T in stacked.items()
    }
    worth = dict.fromkeys(PAIRS, np.full(len(starts), 1 / len(starts)))
    for network, sensors in zip(asked.networks, asked.sensors[0], strict=True):
        for pair in (p for p in _FITTED if p in network.pairs):
            # Camera-lidar is judged by points chosen at each of its ends, the radar by those where the camera is then.
            places = ends[pair] if pair == "camera_lidar" else [centre["camera_lidar"]]
            looks = [look for T in places if (look := network.evidence(pair, sensors, T)) is not None]
            if looks:
                worth[pair] = likelihood(looks, ends[pair])
                centre[pair] = ends[pair][int(worth[pair].argmax())]
    if asked.composed:  # each end of one pair may go with each of the other
        first, second = stacked["camera_lidar"], stacked["lidar_radar"]
        stacked["camera_radar"] = (first[:, None] @ second).reshape(-1, 4, 4)
        worth["camera_radar"] = np.outer(worth["camera_lidar"], worth["lidar_radar"]).ravel()
        centre["camera_radar"] = centre["camera_lidar"] @ centre["lidar_radar"]
    return centre, stacked, worth


@dataclass(frozen=True, eq=False)
class _Asked:
    """A day's frames, ready for the networks."""

    networks: Sequence[FrameNetwork]
    prior: Prior
    sensors: list[list[Any]]  # by frame, by network
    observations: list[Observation]

    @property
    def composed(self) -> bool:
        """Whether a network makes camera_radar of the other two pairs, so that the loop closes by construction."""
        return any(n.composed for n in self.networks)

    @property
    def block(self) -> Int[np.ndarray, " F"]:
        """Block of the bootstrap of each frame."""
        return _blocks([o.drive for o in self.observations])

    def unobservable(self, pair: str) -> Bool[np.ndarray, " 6"]:
        """Degrees of freedom that no frame of the day can determine."""
        measured = any(o.radar_has_elevation for o in self.observations)
        return np.zeros(6, bool) if measured else _BY_ELEVATION[pair]


def _asked_frames(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, networks: Sequence[FrameNetwork],
    frames: FrameSource, progress: Progress,
) -> tuple[_Asked, Counter[str]]:  # fmt: skip
    """Prepare all frames; also counts rejected frames by reason."""
    chosen = _chosen(observations)
    rejected: Counter[str] = Counter()
    asked = _Asked(networks, prior, [], [])
    total = len(chosen)
    for done, frame in enumerate(frames([o.frame_index for o in chosen])):
        progress(done, 2 * total, "prepare frames")
        try:
            asked.sensors.append([n.sensors(frame, chosen[done], prior) for n in networks])
            asked.observations.append(chosen[done])
        except SampleRejectedError as rejection:
            rejected[rejection.reason.value] += 1
    if len(asked.sensors) < _MIN_FRAMES:
        why = ", ".join(f"{n} {name}" for name, n in sorted(rejected.items()))
        raise SolveError(
            f"too few frames for a network: {len(asked.sensors)} of {total} ({why or 'short day'})"
        )
    return asked, rejected


def _fitted_together(
    asked: _Asked, pair: str, candidates: Sequence[np.ndarray], T_camera_lidar: np.ndarray, clock_sigma_s: float
) -> JointDay | None:  # fmt: skip
    """A pair and its clock by all frames at once, if a network returns its evidence.

    `T_camera_lidar` chooses the lidar's points for lidar-radar.
    """
    which = next((i for i, n in enumerate(asked.networks) if pair in n.pairs), None)
    if which is None:
        return None

    sensor, sign = _FITTED[pair]
    gap_s, stated_s = sign * gaps_s(asked.observations, sensor), None
    travels = np.stack([_travel(o, asked.prior) for o in asked.observations])
    if sensor == "camera":
        stated_s = asked.prior.camera.stamp_sigma_s
    else:  # the points are the radar's, whose own travel they show
        travels = travels @ adjoint(inverse(asked.prior.T_lidar_radar)).T
    clock_s = expected_dt_s(gap_s, stated_s)

    def evidence(T: np.ndarray) -> list[Evidence]:
        network, chosen_at = asked.networks[which], T if pair == "camera_lidar" else T_camera_lidar
        found = (network.evidence(pair, sensors[which], chosen_at) for sensors in asked.sensors)
        moving = zip(found, travels, (gap_s - clock_s).tolist(), strict=True)
        return [replace(f, travel=travel, lag_s=lag_s) for f, travel, lag_s in moving if f is not None]

    expected = Expected(
        asked.prior.of(pair), asked.prior.covariance(pair), stated_s or clock_sigma_s, clock_s
    )
    return fitted_day(pair, evidence, asked.block, candidates, expected)


def _product(camera_lidar: PairEstimate, lidar_radar: PairEstimate, prior: Prior) -> PairEstimate:
    """Camera-radar through the lidar."""
    pair, parts, T = "camera_radar", (camera_lidar, lidar_radar), camera_lidar.T
    covariance = compose_covariance(T, camera_lidar.covariance, lidar_radar.covariance)
    common = [p.covariance if p.common_covariance is None else p.common_covariance for p in parts]
    observability = np.clip(1 - np.diag(covariance) / np.diag(prior.covariance(pair)), 0.0, 1.0)
    return PairEstimate(
        pair, T @ lidar_radar.T, covariance, observability, observability >= OBSERVABLE,
        min(p.frames_used for p in parts), common_covariance=compose_covariance(T, *common),
    )  # fmt: skip


def _travel(observation: Observation, prior: Prior) -> Float[np.ndarray, " 6"]:
    """Twist per second of the lidar in its own axes [rad/s, m/s]."""
    yaw_rate_radps = observation.ego_yaw_rate_radps or 0.0
    return np.array([0.0, 0.0, yaw_rate_radps, *own_velocity(observation, prior.T_lidar_radar)])


def _chosen(observations: Mapping[str, Sequence[Observation]]) -> list[Observation]:
    """The selected frames of all pairs in order, thinned evenly."""
    every = {o.frame_index: o for selected in observations.values() for o in selected}
    ordered = [every[i] for i in sorted(every)]
    kept = np.unique(np.linspace(0, len(ordered) - 1, min(len(ordered), _MAX_FRAMES)).astype(int))
    return [ordered[i] for i in kept]


def _pilot_centre(
    asked: _Asked, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, list[np.ndarray]]]:
    """Iterate the guess on pilot frames until it moves less than 0.3 deg: answers are best near the truth.

    Also returns candidates for each pair: the centre of each round and the answer of each pilot frame.
    """
    count, prior = len(asked.sensors), asked.prior
    centre = {pair: prior.of(pair) for pair in PAIRS}
    rows: list[int] = np.unique(np.linspace(0, count - 1, min(count, _PILOT_FRAMES)).astype(int)).tolist()
    rows *= -(-_FEWEST_GUESSES // len(rows))
    candidates: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    for _ in range(_PILOT_ROUNDS):
        found = _ask(asked, rows, centre, rng, lambda _: None)
        moved = {p: mean_answer(found[p], prior.of(p), prior.covariance(p)) for p in PAIRS}
        turned_rad = max(float(rotation_angle_rad(moved[p] @ inverse(centre[p]))) for p in PAIRS)
        for pair, own in found.items():
            candidates[pair] += [moved[pair], *(exp_se3(own.answer) @ own.T_centre)]
        centre = moved
        if turned_rad < _CONVERGED_RAD:
            break
    return centre, candidates


def _ask_all(
    asked: _Asked, centre: Mapping[str, np.ndarray], rng: np.random.Generator, progress: Progress
) -> dict[str, Answers]:
    total = len(asked.sensors)
    return _ask(asked, range(total), centre, rng, lambda i: progress(total + i, 2 * total, "ask networks"))


def _ask(
    asked: _Asked,
    rows: Sequence[int],
    centre: Mapping[str, np.ndarray],
    rng: np.random.Generator,
    watch: Callable[[int], None],
) -> dict[str, Answers]:
    """Answers of all networks on these frames, each at its own guess about the centre."""
    offsets = _scattered(len(rows), rng)
    guesses = [_guess(centre, own, composed=asked.composed) for own in offsets]
    answers: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    variances: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    for i, row in enumerate(rows):
        watch(i)
        for network, sensors in zip(asked.networks, asked.sensors[row], strict=True):
            answer = network.answer(sensors, guesses[i])
            for pair in network.pairs:
                answers[pair].append(answer.T[pair])
                variances[pair].append(answer.variance[pair])
    block = _blocks([asked.observations[row].drive for row in rows])
    bias = {pair: np.array(sigma) for pair, sigma in BIAS_SIGMA.items()}
    for network in asked.networks:
        bias |= {pair: network.bias_sigma[pair] for pair in network.pairs if pair in network.bias_sigma}
    return {
        pair: Answers(
            centre[pair], twists_about(centre[pair], np.stack([g[pair] for g in guesses])),
            twists_about(centre[pair], np.stack(answers[pair])), np.stack(variances[pair]), block,
            len(set(rows)), bias[pair],
        )
        for pair in PAIRS
    }  # fmt: skip


def _scattered(
    count: int, rng: np.random.Generator, sigma_rad: float = _SCATTER_RAD, sigma_m: float = _SCATTER_M
) -> Float[np.ndarray, "N 3 6"]:
    """Twists by row and pair with mean 0, so that the effect of the guesses on the answers is no offset."""
    sd = np.array([sigma_rad] * 3 + [sigma_m] * 3)
    offsets = rng.normal(size=(count, len(PAIRS), 6)).clip(-2, 2) * sd
    return np.asarray(offsets - offsets.mean(axis=0))


def _guess(
    centre: Mapping[str, np.ndarray], offsets: Float[np.ndarray, "3 6"], *, composed: bool
) -> dict[str, np.ndarray]:
    """A guess for every pair; the loop need not close, unless the network composes camera_radar of the others."""
    guess = {pair: exp_se3(offsets[k]) @ centre[pair] for k, pair in enumerate(PAIRS)}
    if composed:
        guess["camera_radar"] = guess["camera_lidar"] @ guess["lidar_radar"]
    return guess


def _blocks(drives: Sequence[int]) -> Int[np.ndarray, " N"]:
    """Blocks of the bootstrap: drives, or equal parts of a day with too few drives."""
    if len(set(drives)) >= _BLOCKS:
        return np.array(drives)
    return np.arange(len(drives)) * _BLOCKS // max(len(drives), 1)


def _estimate(pair: str, answers: Answers, asked: _Asked, rng: np.random.Generator) -> PairEstimate:
    prior = asked.prior
    return day_estimate(pair, answers, prior.of(pair), prior.covariance(pair), rng, asked.unobservable(pair))


def _halves_disagree(
    pair: str, block: np.ndarray, estimate: Callable[[str, np.ndarray], PairEstimate]
) -> list[Check]:
    """A failed check, if estimates from the odd and from the even blocks differ by more than their sigmas allow."""
    odd = np.unique(block, return_inverse=True)[1].ravel() % 2 == 1
    halves = [estimate(pair, rows) for rows in (odd, ~odd)]
    apart = log_se3(halves[0].T @ inverse(halves[1].T))
    both = halves[0].observable & halves[1].observable
    sigma = np.sqrt(np.diag(halves[0].covariance) + np.diag(halves[1].covariance))
    ratio = np.where(both, np.abs(apart) / sigma, 0.0)
    if ratio.max() <= _HALVES_SIGMAS:
        return []
    return [Check(f"two halves of the day differ by {ratio.max():.1f} of their sigmas", "witnesses_disagree")]
