"""What is asked of networks and what they answer: one frame at a guess, many frames at guesses about a centre."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.learn.infer.aggregate import BIAS_SIGMA, Answers, day_estimate, twists_about
from pipeline.learn.infer.joint_day import Evidence
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_se3
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["FITTED", "Asked", "FrameAnswer", "FrameNetwork", "ask", "guess_about", "scattered"]

# Guesses are scattered by this much (standard deviation per axis): several times the scatter of one frame's answers.
_SCATTER_RAD, _SCATTER_M = np.radians(0.4), 0.03
_BLOCKS = 8  # of the bootstrap, at least
# Degrees of freedom that need elevations: unobservable with a radar that measures none.
_BY_ELEVATION = {
    "camera_lidar": np.zeros(6, bool),
    "camera_radar": np.array([1, 0, 1, 0, 1, 0], bool),
    "lidar_radar": np.array([1, 1, 0, 0, 0, 1], bool),
}
# Pairs that are fitted to all frames at once: the sensor whose stamps are compared with the sweep's, and 1 where it is
# the parent, -1 where the child (time offsets are parent less child).
FITTED = {"camera_lidar": ("camera", 1.0), "lidar_radar": ("radar", -1.0)}


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

    @property
    def composed(self) -> bool:
        """True if camera_radar is the product of the other two pairs before its correction."""

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """By pair, sigma of the bias that all answers share (see `aggregate`); a pair is missing where unknown."""

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> Any:
        """Inputs of `answer` from a frame; raises SampleRejectedError if it shows too little."""

    def evidence(self, pair: str, sensors: Any, T_camera_lidar: np.ndarray) -> Evidence | None:
        """Matching evidence of a pair, lidar points chosen at a guess; None if the network has none of any frame."""

    def answer(self, sensors: Any, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms from one frame, started at a guess for every pair."""


@dataclass(frozen=True, eq=False)
class Asked:
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

    def estimate(self, pair: str, answers: Answers, rng: np.random.Generator) -> PairEstimate:
        """By the answers of these frames."""
        T_prior, P = self.prior.of(pair), self.prior.covariance(pair)
        return day_estimate(pair, answers, T_prior, P, rng, self.unobservable(pair))


def ask(
    asked: Asked, rows: Sequence[int], centre: Mapping[str, np.ndarray], rng: np.random.Generator,
    watch: Callable[[int], None],
) -> dict[str, Answers]:  # fmt: skip
    """Answers of all networks on these frames, each at its own guess about the centre."""
    offsets = scattered(len(rows), rng)
    guesses = [guess_about(centre, own, composed=asked.composed) for own in offsets]
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


def scattered(
    count: int, rng: np.random.Generator, sigma_rad: float = _SCATTER_RAD, sigma_m: float = _SCATTER_M
) -> Float[np.ndarray, "N 3 6"]:
    """Twists by row and pair with mean 0, so that the effect of the guesses on the answers is no offset."""
    sd = np.array([sigma_rad] * 3 + [sigma_m] * 3)
    offsets = rng.normal(size=(count, len(PAIRS), 6)).clip(-2, 2) * sd
    return np.asarray(offsets - offsets.mean(axis=0))


def guess_about(
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
