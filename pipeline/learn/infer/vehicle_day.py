"""A vehicle-day by networks: ask them on every frame at scattered guesses, go where they point, and average."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import PairEstimate, Prior, Solution
from pipeline.geometry.se3 import exp_se3, inverse, log_se3, rotation_angle_rad
from pipeline.learn.infer.aggregate import Answers, day_estimate, mean_answer, twists_about
from pipeline.learn.sample.frame_sample import SampleRejectedError
from pipeline.results import Progress, silent
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = [
    "FrameAnswer",
    "FrameNetwork",
    "FrameSource",
    "day_answers",
    "single_frame_solution",
    "solve_by_networks",
]

# Guesses are scattered by this much (sd per axis): several times what one frame's answer scatters by.
_SCATTER_RAD, _SCATTER_M = np.radians(0.4), 0.03
_SCOUTS = 24  # frames that find out where to ask all of them
_SCOUT_ROUNDS, _SETTLED_RAD = 3, np.radians(0.3)
_MIN_FRAMES, _MAX_FRAMES = 8, 160
_BLOCKS = 8
_GUESSES_OF_ONE_FRAME, _FEWEST_GUESSES = 16, 8
_HALVES_SIGMAS = 4.0
# Degrees of freedom that only elevations tell: of a radar that measures none nothing is known about them.
_ELEVATION = {
    "camera_lidar": np.zeros(6, bool),
    "camera_radar": np.array([1, 0, 1, 0, 1, 0], bool),
    "lidar_radar": np.array([1, 1, 0, 0, 0, 1], bool),
}

# frames(indices) yields the frames of a day with these frame_index, in order.
FrameSource = Callable[[Sequence[int]], Iterator[Frame]]


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """What a network says of one frame, for the pairs that it estimates."""

    T: Mapping[str, np.ndarray]
    variance: Mapping[str, np.ndarray]  # of a twist on the left: rad^2, m^2


@runtime_checkable
class FrameNetwork(Protocol):
    """A network as the day sees it."""

    @property
    def pairs(self) -> tuple[str, ...]:
        """Pairs that it estimates."""
        ...

    @property
    def composed(self) -> bool:
        """True where its camera_radar stands on the product of the other two."""
        ...

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """By pair, what all its answers may be off by alike; pairs are missing where nobody measured it."""
        ...

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> Any:
        """What `answer` needs of a frame; SampleRejectedError where it shows too little."""
        ...

    def answer(self, sensors: Any, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms from one frame, started at a guess for every pair."""
        ...


def solve_by_networks(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    *,
    networks: Sequence[FrameNetwork],
    frames: FrameSource,
    method: str,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
    """Estimate all triggered pairs; the others keep the prior.

    Args:
        observations: selected frames per pair; all of them are asked about all pairs.
        prior: start, and what stays where the networks know nothing.
        networks: of which each pair has one.
        frames: the day's frames.
        method: name of the solution.
        seed: of guesses and bootstrap.
        triggered: pairs to estimate.
        progress: told about every frame.

    Raises:
        SolveError: too few frames can be shown to the networks.
    """
    rng = np.random.default_rng([seed, 7])
    asked, found, rejected = _asked_day(observations, prior, networks, frames, rng, progress)
    estimates = {
        pair: replace(_estimate(pair, found[pair], asked, rng), frames_rejected=dict(rejected))
        if pair in triggered
        else _kept(pair, prior)
        for pair in PAIRS
    }
    doubts = {pair: _halves_disagree(pair, found[pair], asked, rng) for pair in triggered}
    if any(n.composed for n in networks) or len(triggered) < len(PAIRS):
        return Solution(method, estimates, doubts=doubts)  # a loop that closes by construction shows nothing
    rotation_rad, translation_m = _loop(estimates)
    return Solution(method, estimates, rotation_rad, translation_m, doubts)


def single_frame_solution(
    frame: Frame,
    observation: Observation,
    prior: Prior,
    *,
    networks: Sequence[FrameNetwork],
    method: str,
    seed: int,
) -> Solution:
    """The same from one frame: its answers at many guesses, with the sigma that the network itself states.

    Raises:
        SolveError: the frame cannot be shown to the networks.
    """
    try:
        sensors = [n.sensors(frame, observation, prior) for n in networks]
    except SampleRejectedError as rejection:
        raise SolveError(f"frame {frame.frame_index}: {rejection.reason.value}") from rejection
    asked = _Asked(networks, prior, [sensors], [observation])
    rng = np.random.default_rng([seed, 7])
    centre = _scouted(asked, {pair: prior.of(pair) for pair in PAIRS}, rng)
    found = _ask(asked, [0] * _GUESSES_OF_ONE_FRAME, centre, rng, lambda _: None)
    return Solution(method, {pair: _estimate(pair, found[pair], asked, rng) for pair in PAIRS})


@dataclass(frozen=True, eq=False)
class _Asked:
    """Frames as the networks see them."""

    networks: Sequence[FrameNetwork]
    prior: Prior
    sensors: list[list[Any]]  # by frame, by network
    observations: list[Observation]

    def blind(self, pair: str) -> Bool[np.ndarray, " 6"]:
        """What no frame of the day can tell."""
        seen = any(o.radar_has_elevation for o in self.observations)
        return np.zeros(6, bool) if seen else _ELEVATION[pair]


def day_answers(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    *,
    networks: Sequence[FrameNetwork],
    frames: FrameSource,
    seed: int,
) -> dict[str, Answers]:
    """What `solve_by_networks` makes its estimates of: each pair's answers at scattered guesses.

    Raises:
        SolveError: too few frames can be shown to the networks.
    """
    return _asked_day(observations, prior, networks, frames, np.random.default_rng([seed, 7]), silent)[1]


def _asked_day(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    networks: Sequence[FrameNetwork],
    frames: FrameSource,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[_Asked, dict[str, Answers], Counter[str]]:
    """Show all frames, walk to where they point, ask them there; with the frames left out, by reason."""
    chosen = _chosen(observations)
    rejected: Counter[str] = Counter()
    asked = _Asked(networks, prior, [], [])
    total = len(chosen)
    for done, frame in enumerate(frames([o.frame_index for o in chosen])):
        progress(done, 2 * total, "see frames")
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
    centre = _scouted(asked, {pair: prior.of(pair) for pair in PAIRS}, rng)
    everything = range(len(asked.sensors))
    found = _ask(asked, everything, centre, rng, lambda i: progress(total + i, 2 * total, "ask networks"))
    return asked, found, rejected


def _chosen(observations: Mapping[str, Sequence[Observation]]) -> list[Observation]:
    """The selected frames of all pairs in order, thinned evenly."""
    every = {o.frame_index: o for selected in observations.values() for o in selected}
    ordered = [every[i] for i in sorted(every)]
    kept = np.unique(np.linspace(0, len(ordered) - 1, min(len(ordered), _MAX_FRAMES)).astype(int))
    return [ordered[i] for i in kept]


def _scouted(asked: _Asked, centre: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Go where a few frames point, until they point here: answers are best when asked near the truth."""
    count = len(asked.sensors)
    rows: list[int] = np.unique(np.linspace(0, count - 1, min(count, _SCOUTS)).astype(int)).tolist()
    rows *= -(-_FEWEST_GUESSES // len(rows))
    for _ in range(_SCOUT_ROUNDS):
        found = _ask(asked, rows, centre, rng, lambda _: None)
        prior = asked.prior
        moved = {p: mean_answer(found[p], prior.of(p), prior.covariance(p)) for p in PAIRS}
        way = max(float(rotation_angle_rad(moved[p] @ inverse(centre[p]))) for p in PAIRS)
        centre = moved
        if way < _SETTLED_RAD:
            break
    return centre


def _ask(
    asked: _Asked,
    rows: Sequence[int],
    centre: Mapping[str, np.ndarray],
    rng: np.random.Generator,
    told: Callable[[int], None],
) -> dict[str, Answers]:
    """Answers of all networks on these frames, each at its own guess about the centre."""
    offsets = _scattered(len(rows), rng)
    composed = any(n.composed for n in asked.networks)
    guesses = [_guess(centre, offsets[i], composed=composed) for i in range(len(rows))]
    answers: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    variances: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    for i, row in enumerate(rows):
        told(i)
        for network, sensors in zip(asked.networks, asked.sensors[row], strict=True):
            said = network.answer(sensors, guesses[i])
            for pair in network.pairs:
                answers[pair].append(said.T[pair])
                variances[pair].append(said.variance[pair])
    block = _blocks([asked.observations[row].drive for row in rows])
    bias = {pair: n.bias_sigma[pair] for n in asked.networks for pair in n.pairs if pair in n.bias_sigma}
    return {
        pair: Answers(
            centre[pair],
            twists_about(centre[pair], np.stack([g[pair] for g in guesses])),
            twists_about(centre[pair], np.stack(answers[pair])),
            np.stack(variances[pair]),
            block,
            len(set(rows)),
            bias.get(pair),
        )
        for pair in PAIRS
    }


def _scattered(count: int, rng: np.random.Generator) -> Float[np.ndarray, "N 3 6"]:
    """Twists by row and pair whose mean is 0: what the guesses do to the answers must not pass for a shift."""
    sd = np.array([_SCATTER_RAD] * 3 + [_SCATTER_M] * 3)
    offsets = rng.normal(size=(count, len(PAIRS), 6)).clip(-2, 2) * sd
    return np.asarray(offsets - offsets.mean(axis=0))


def _guess(
    centre: Mapping[str, np.ndarray], offsets: Float[np.ndarray, "3 6"], *, composed: bool
) -> dict[str, np.ndarray]:
    """A guess for every pair; they need not close the loop, unless the network makes camera_radar of the others."""
    guess = {pair: exp_se3(offsets[k]) @ centre[pair] for k, pair in enumerate(PAIRS)}
    if composed:
        guess["camera_radar"] = guess["camera_lidar"] @ guess["lidar_radar"]
    return guess


def _blocks(drives: Sequence[int]) -> Int[np.ndarray, " N"]:
    """Blocks of the bootstrap: drives, or equal stretches of the day where there are too few of them."""
    if len(set(drives)) >= _BLOCKS:
        return np.array(drives)
    return np.arange(len(drives)) * _BLOCKS // max(len(drives), 1)


def _estimate(pair: str, answers: Answers, asked: _Asked, rng: np.random.Generator) -> PairEstimate:
    prior = asked.prior
    return day_estimate(pair, answers, prior.of(pair), prior.covariance(pair), rng, asked.blind(pair))


def _kept(pair: str, prior: Prior) -> PairEstimate:
    nothing = np.zeros(6)
    return PairEstimate(pair, prior.of(pair), prior.covariance(pair), nothing, nothing.astype(bool), 0)


def _halves_disagree(pair: str, answers: Answers, asked: _Asked, rng: np.random.Generator) -> list[str]:
    """Every other block by itself must say the same."""
    odd = np.unique(answers.block, return_inverse=True)[1].ravel() % 2 == 1
    halves = [_estimate(pair, _part(answers, rows), asked, rng) for rows in (odd, ~odd)]
    apart = log_se3(halves[0].T @ inverse(halves[1].T))
    both = halves[0].observable & halves[1].observable
    sigma = np.sqrt(np.diag(halves[0].covariance) + np.diag(halves[1].covariance))
    ratio = np.where(both, np.abs(apart) / sigma, 0.0)
    if ratio.max() <= _HALVES_SIGMAS:
        return []
    return [f"two halves of the day differ by {ratio.max():.1f} of their sigmas"]


def _part(answers: Answers, rows: np.ndarray) -> Answers:
    return Answers(
        answers.T_centre,
        answers.guess[rows],
        answers.answer[rows],
        answers.variance[rows],
        answers.block[rows],
        max(1, round(answers.frames * float(rows.mean()))),
        answers.bias_sigma,
    )


def _loop(estimates: Mapping[str, PairEstimate]) -> tuple[float, float]:
    """Angle [rad] and shift [m] by which three independent estimates miss each other."""
    T = estimates["camera_lidar"].T @ estimates["lidar_radar"].T @ inverse(estimates["camera_radar"].T)
    return float(rotation_angle_rad(T)), float(np.linalg.norm(T[:3, 3]))
