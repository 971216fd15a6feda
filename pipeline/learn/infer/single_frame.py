"""One frame by networks, as after an abrupt change: searches from all over the prior, weighed by what fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.core.errors import SolveError
from pipeline.learn.infer.aggregate import twists_about
from pipeline.learn.infer.asking import FITTED, Asked, FrameNetwork, ask, guess_about, scattered
from pipeline.learn.infer.joint_day import likelihood
from pipeline.learn.sample.frame_sample import SampleRejectedError
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_se3
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["single_frame_solution"]

_GUESSES = 16
_STARTS, _SEARCH_ROUNDS = 12, 2  # as many passes as pilot frames of a day take, spread over the prior


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
    asked = Asked(networks, prior, [sensors], [observation])
    rng = np.random.default_rng([seed, 7])
    centre, ends, worth = _searched(asked, rng)
    found = ask(asked, [0] * _GUESSES, centre, rng, lambda _: None)
    estimates = {}
    for pair, own in found.items():
        told = replace(own, ends=twists_about(centre[pair], ends[pair]), ends_worth=worth[pair])
        estimates[pair] = asked.estimate(pair, told, rng)
    if not estimates["camera_lidar"].observable.any():
        # The picture does not determine it, so nor the radar's pose.
        estimates["camera_radar"] = PairEstimate.at_prior("camera_radar", prior)
    return Solution(method, estimates)


def _searched(
    asked: Asked, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Ends of searches from starts all over the prior on one frame: by pair the centre, each end, and its worth.

    Only far starts show that a frame fits in several places: near ones all end in the same place. But some of them end
    where nothing fits, which the network's evidence shows.
    """
    prior = asked.prior
    starts = scattered(_STARTS, rng, prior.rotation_sigma_rad, prior.translation_sigma_m)
    guess = {pair: prior.of(pair) for pair in PAIRS}
    ends: dict[str, list[np.ndarray]] = {pair: [] for pair in PAIRS}
    for offsets in starts:
        at = guess_about(guess, offsets, composed=asked.composed)
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
        for pair in (p for p in FITTED if p in network.pairs):
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
