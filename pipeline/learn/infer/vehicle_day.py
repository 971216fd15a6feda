"""A vehicle-day by networks: iterate the guess on pilot frames, then fit each pair to the evidence of all frames.

Camera-radar is then the product of the fits. Networks without evidence, and those of camera-radar alone, are asked
about all frames near the guess, and their answers are averaged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.learn.infer.aggregate import OBSERVABLE, Answers, mean_answer
from pipeline.learn.infer.asking import FITTED, Asked, FrameNetwork, ask
from pipeline.learn.infer.joint_day import Evidence, Expected, JointDay, fitted_day
from pipeline.learn.sample.clouds import own_velocity
from pipeline.learn.sample.frame_sample import SampleRejectedError
from pipeline.objective.stamp_gaps import expected_dt_s, gaps_s
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution
from pipeline.rig.se3 import adjoint, compose_covariance, exp_se3, inverse, log_se3, rotation_angle_rad
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["FrameSource", "solve_by_networks"]

_PILOT_FRAMES = 24  # on which the guess is iterated before all frames are used
_PILOT_ROUNDS, _CONVERGED_RAD = 3, np.radians(0.3)
_MIN_FRAMES, _MAX_FRAMES = 8, 160
_FEWEST_GUESSES = 8  # a regression on fewer answers has no scatter
_HALVES_SIGMAS = 4.0  # beyond it two halves of a day disagree
# frames(indices) yields the frames of a day with these frame_index, in order.
FrameSource = Callable[[Sequence[int]], Iterator[Frame]]


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
    for pair in FITTED:
        day = _fitted_together(asked, pair, candidates[pair], centre["camera_lidar"], clock_sigma_s)
        if day is not None:
            together[pair], centre[pair] = day, day.fit.T
    is_product = asked.composed and len(together) == len(FITTED)
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
        return asked.estimate(pair, answers, rng)

    estimates = {
        pair: replace(estimate(pair), frames_rejected=dict(rejected))
        if pair in triggered
        else PairEstimate.at_prior(pair, prior)
        for pair in PAIRS
    }
    failed: dict[str, list[Check]] = {}
    for pair in FITTED if is_product else triggered:
        own = together[pair].failed if pair in together else []
        failed[pair] = _halves_disagree(pair, asked.block, estimate) + own
    if is_product:
        failed["camera_radar"] = [check for pair in FITTED for check in failed[pair]]
        failed = {pair: failed[pair] for pair in triggered}
    if asked.composed or len(triggered) < len(PAIRS):
        # A loop that closes by construction is no evidence.
        return Solution(method, estimates, failed_checks=failed)
    loop = estimates["camera_lidar"].T @ estimates["lidar_radar"].T @ inverse(estimates["camera_radar"].T)
    translation_m = float(np.linalg.norm(loop[:3, 3]))
    return Solution(method, estimates, float(rotation_angle_rad(loop)), translation_m, failed)


def _asked_frames(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, networks: Sequence[FrameNetwork],
    frames: FrameSource, progress: Progress,
) -> tuple[Asked, Counter[str]]:  # fmt: skip
    """Prepare all frames; also counts rejected frames by reason."""
    chosen = _chosen(observations)
    rejected: Counter[str] = Counter()
    asked = Asked(networks, prior, [], [])
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
        few = f"{len(asked.sensors)} of {total} ({why or 'short day'})"
        raise SolveError(f"too few frames for a network: {few}")
    return asked, rejected


def _fitted_together(
    asked: Asked, pair: str, candidates: Sequence[np.ndarray], T_camera_lidar: np.ndarray, clock_sigma_s: float
) -> JointDay | None:  # fmt: skip
    """A pair and its clock by all frames at once, if a network returns its evidence.

    `T_camera_lidar` chooses the lidar's points for lidar-radar.
    """
    which = next((i for i, n in enumerate(asked.networks) if pair in n.pairs), None)
    if which is None:
        return None

    sensor, sign = FITTED[pair]
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

    T_prior, P = asked.prior.of(pair), asked.prior.covariance(pair)
    expected = Expected(T_prior, P, stated_s or clock_sigma_s, clock_s)
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
    asked: Asked, rng: np.random.Generator
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
        found = ask(asked, rows, centre, rng, lambda _: None)
        moved = {p: mean_answer(found[p], prior.of(p), prior.covariance(p)) for p in PAIRS}
        turned_rad = max(float(rotation_angle_rad(moved[p] @ inverse(centre[p]))) for p in PAIRS)
        for pair, own in found.items():
            candidates[pair] += [moved[pair], *(exp_se3(own.answer) @ own.T_centre)]
        centre = moved
        if turned_rad < _CONVERGED_RAD:
            break
    return centre, candidates


def _ask_all(
    asked: Asked, centre: Mapping[str, np.ndarray], rng: np.random.Generator, progress: Progress
) -> dict[str, Answers]:
    total = len(asked.sensors)
    return ask(asked, range(total), centre, rng, lambda i: progress(total + i, 2 * total, "ask networks"))


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
