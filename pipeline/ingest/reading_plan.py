"""Plan of the parts of a long day's logs to read, from their indices and short samples of the car's motion.

A calibration takes about a hundred frames, and consecutive frames of a drive are similar. The day is divided
into parts with equal numbers of sweeps, with one possible burst in the middle of each. Bursts are then chosen
greedily to maximise the sum over classes of time, speed, turn and place of log(1 + bursts in the class). This
function is submodular, as in the choice of frames in `calibrate/select/frames.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.core.rigs import RadarTopics
from pipeline.ingest.containers.reader import LogReader, RawMessage
from pipeline.ingest.containers.timeline import PAUSE_NS, Stretches, Timeline
from pipeline.ingest.directions_and_units import doppler_speed
from pipeline.ingest.messages.decoding import DECODE_ERRORS, decode, header_stamp_ns
from pipeline.ingest.messages.odometry import EgoState, EgoTrack
from pipeline.ingest.messages.radar import read_radar
from pipeline.ingest.roles import IMAGE, INFO, LIDAR, ODOMETRY, RADAR, TF_STATIC, Role
from pipeline.rig.rig import Rig

__all__ = [
    "BURST_TRIOS", "BurstMotion", "Reading", "choose_bursts", "plan_reading", "plan_sweeps",
    "possible_bursts", "rare_topics",
]  # fmt: skip

_GLANCE_NS = 250_000_000  # on each side: odometry comes at 10 Hz or more, and a chunk often holds a second
_ANCHORS = (LIDAR, RADAR, IMAGE)  # messages that define moments, the first that a rig has
_LATENCY_GLANCES = 3  # at the day's begin, middle and end: clocks drift by some hundred ppm
# Messages are logged after their stamps, with a latency by sensor: the stretch to read exceeds the burst by
# the largest observed latency difference plus this margin, which also covers odometry of 2 Hz.
_MARGIN_NS = 500_000_000
_MOST_MARGIN_NS = 10 * 10**9  # beyond it log time does not indicate the time of measurement
_FIT_SHARE = 1 / 3  # of a scan's detections; below it the Doppler speed is invalid
# Tracks of moving clusters count from their second scan on (`calibrate/select/triggers.py`), and Doppler
# aliases are resolved within a few more scans; 20 scans are 2 s at 10 Hz, shorter than the blocks of held-out
# frames. Bursts of 10 were as good on two simulated days of three, and one radar was held on the third.
BURST_TRIOS = 20
# If most sweeps are not part of 20 without a pause, tracks gain nothing, and more scenes are better: 80
# sweeps of the real day in runs of 20, 10 and 5 had a camera-lidar elevation error of 0.20, 0.04 and 0.01
# deg.
_CLUMP_TRIOS = 5
_CHOICE = 3  # possible bursts per burst to read; for each possible one, a short stretch of odometry is read
# Limits of classes: standing, creeping, city, main road, country road, motorway; turning right, bending,
# straight ...
_SPEEDS_MPS = np.array([1.0, 5.0, 10.0, 16.0, 25.0])
_YAW_RATES_RADPS = np.radians([-8.0, -2.0, 2.0, 8.0])
_TIE = 1e-3  # smaller than any real difference of the objective
_PLACE_M = 200.0  # side of a place's cell: a lidar sees the same scene within it


@dataclass(frozen=True, eq=False)
class PossibleBursts:
    """Bursts that can be read, in order of time: first and last moment, sweep in the middle, sweeps."""

    spans_ns: Int64[np.ndarray, "M 2"]
    middle_ns: Int64[np.ndarray, "M 3"]
    sweeps: int


# Motion of the car in the middle of each possible burst: speed [m/s], yaw rate [rad/s] (positive to the left) and
# position [m] in any frame that is constant for the day; NaN where it was not measured.
BurstMotion = Float[np.ndarray, "M 4"]


def _motion_of(state: EgoState | None) -> tuple[float, ...]:
    if state is None:
        return (np.nan,) * 4
    return state.speed_mps, state.yaw_rate_radps, *state.T_odom_vehicle[:2, 3]


@dataclass(frozen=True)
class Reading:
    """Parts of a day to read: bursts of moments by log time, and `around` them everything to read.

    `sweeps` counts those in the logs, `planned` those of as many bursts of full length.
    """

    bursts: Stretches
    around: Stretches
    sweeps: int
    planned: int


@dataclass(frozen=True)
class _Day:
    """The logs that have an index."""

    logs: tuple[LogReader, ...]
    rig: Rig
    roles: Mapping[str, Role]  # by topic

    def messages(self, roles: Collection[Role], within: Stretches) -> Iterator[tuple[Role, RawMessage]]:
        """Messages of some roles with their role; unreadable logs are skipped here and counted later."""
        topics = {topic for topic, role in self.roles.items() if role in roles}
        for log in self.logs:
            with suppress(OSError):
                for message in log.scan(topics, within):
                    yield self.roles[message.channel.topic], message


def plan_reading(
    logs: Mapping[LogReader, Timeline | None], rig: Rig, roles: Mapping[str, Role], budget: int
) -> Reading | None:
    """Bursts to read; None if the whole day is to be read.

    The whole day is read if it has no more sweeps than the budget, if most logs have no index, or if log time
    is unrelated to stamps. Without odometry, the rig's Doppler gives the motion.
    """
    indexed = {log: t for log, t in logs.items() if t is not None}
    held = {
        role: topic for topic, role in roles.items() if any(t.messages.get(topic) for t in indexed.values())
    }
    anchors = [role for role in held if role.what in _ANCHORS]
    if not anchors:
        return None
    anchor = min(anchors, key=lambda role: _ANCHORS.index(role.what))
    about = held[anchor]
    timeline = Timeline.joined(t for t in indexed.values() if t.messages.get(about))
    sweeps = timeline.messages.get(about, 0)
    counted = timeline.counted.get(about)
    if counted is None or sweeps <= budget or 2 * len(indexed) < len(logs) or not timeline.recorded.length_ns:
        return None
    day = _Day(tuple(indexed), rig, roles)
    by = next((r for r in (ODOMETRY, *anchors) if r in held and (r == ODOMETRY or r.what == RADAR)), None)
    possible = possible_bursts(counted.times_ns(), budget, is_motion_known=by is not None)
    motion = _motion_at(day, possible.middle_ns, by)
    needed = {role for role in held if role.is_capture}
    margin_ns = _margin_ns(day, possible.middle_ns, needed, anchor)
    if margin_ns is None:
        return None
    return _reading(possible, motion, sweeps, budget, margin_ns)


def plan_sweeps(
    logged_ns: Int64[np.ndarray, " N"], stamps_ns: Int64[np.ndarray, " N"], ego: EgoTrack, budget: int
) -> Reading:
    """Bursts of a day that had to be read whole because its logs have no index."""
    order = np.argsort(logged_ns, kind="stable")
    possible = possible_bursts(logged_ns[order], budget, is_motion_known=len(ego) > 0)
    stamps = stamps_ns[order][np.searchsorted(logged_ns[order], possible.middle_ns[:, 1])]
    motion = np.array([_motion_of(ego.at(stamp)) for stamp in stamps.tolist()], np.float64)
    return _reading(possible, motion, len(order), budget, 0)


def rare_topics(timeline: Timeline, roles: Mapping[str, Role]) -> tuple[dict[str, Role], Stretches]:
    """Topics that a driver may log only once, with their roles; and spans of their first messages."""
    rare = {
        topic: role
        for topic, role in roles.items()
        if (role == TF_STATIC or role.what == INFO) and topic in timeline.first
    }
    return rare, Stretches.merged(timeline.first[topic] for topic in rare)


def _reading(
    possible: PossibleBursts, motion: BurstMotion, sweeps: int, budget: int, margin_ns: int
) -> Reading:
    chosen = choose_bursts(motion, -(-budget // possible.sweeps))
    bursts = Stretches.merged((int(start), int(end)) for start, end in possible.spans_ns[chosen])
    return Reading(bursts, bursts.widened(margin_ns), sweeps, min(sweeps, possible.sweeps * len(chosen)))


def _motion_at(day: _Day, middle_ns: Int64[np.ndarray, "M 3"], by: Role | None) -> BurstMotion:
    """Motion of the car at these sweeps, from odometry or from a radar scan's Doppler."""
    motion = np.full((len(middle_ns), 4), np.nan)
    if by is None:
        return motion
    edges = _between(middle_ns)
    for _, message in day.messages({by}, _glances(middle_ns, _GLANCE_NS)):
        i = int(np.searchsorted(edges, message.log_time_ns))
        if not np.isnan(motion[i, 0]):
            continue
        with suppress(*DECODE_ERRORS):
            if by.what == RADAR:
                motion[i, 0] = _speed_by_doppler(message, day.rig.radars[by.sensor])
            else:
                track = EgoTrack()
                track.add(0, decode(message.channel, message.data))
                motion[i] = _motion_of(track.at(0))
    return motion


def _speed_by_doppler(message: RawMessage, radar: RadarTopics) -> float:
    """Speed from a scan; NaN if it shows no static world."""
    cloud = read_radar(decode(message.channel, message.data), message.channel.msgtype, radar)
    distance = np.linalg.norm(cloud.xyz_m, axis=1, keepdims=True)
    directions = (cloud.xyz_m / np.maximum(distance, 1e-3)).astype(np.float64)
    rates = cloud.range_rate_mps.astype(np.float64)
    speed, share = doppler_speed(directions, rates, radar.doppler_period_mps)
    return speed if share >= _FIT_SHARE else np.nan


def _margin_ns(day: _Day, middle_ns: Int64[np.ndarray, "M 3"], needed: set[Role], anchor: Role) -> int | None:
    """Margin to read before and after each burst [ns].

    None if it would be too large, or if a needed role is never logged near the anchor.
    """
    glances = middle_ns[np.unique(np.linspace(0, len(middle_ns) - 1, _LATENCY_GLANCES).round().astype(int))]
    edges = _between(glances)
    late: dict[tuple[int, Role], list[int]] = {}
    measured = {role for role in day.roles.values() if role != TF_STATIC and role.what != INFO}
    for role, message in day.messages(measured, _glances(glances, _MARGIN_NS)):
        stamp = header_stamp_ns(message.channel, message.data)
        if stamp is not None:
            glance = int(np.searchsorted(edges, message.log_time_ns))
            late.setdefault((glance, role), []).append(message.log_time_ns - stamp)
    median = {key: int(np.median(values)) for key, values in late.items()}
    apart = [
        abs(value - median[glance, anchor])
        for (glance, _), value in median.items()
        if (glance, anchor) in median
    ]
    seen = {role for glance, role in median if (glance, anchor) in median}
    margin_ns = _MARGIN_NS + max(apart, default=0)
    return margin_ns if needed <= seen and margin_ns <= _MOST_MARGIN_NS else None


def _between(middle_ns: Int64[np.ndarray, "M 3"]) -> Int64[np.ndarray, " M-1"]:
    """Times that separate each middle sweep from the next."""
    return (middle_ns[1:, 1] + middle_ns[:-1, 1]) // 2


def _glances(middle_ns: Int64[np.ndarray, "M 3"], half_ns: int) -> Stretches:
    """Stretch about each middle sweep, to its neighbours: the index gives its time between them."""
    begin = np.minimum(middle_ns[:, 0], middle_ns[:, 1] - half_ns)
    end = np.maximum(middle_ns[:, 2], middle_ns[:, 1] + half_ns)
    far = _MOST_MARGIN_NS
    begin, end = np.maximum(begin, middle_ns[:, 1] - far), np.minimum(end, middle_ns[:, 1] + far)
    return Stretches.merged(zip(begin.tolist(), end.tolist(), strict=True))


def possible_bursts(
    sweeps_ns: Int64[np.ndarray, " N"], budget: int, *, is_motion_known: bool
) -> PossibleBursts:
    """Bursts that can be read, in order of time, all with the same number of sweeps.

    A burst is within a stretch without pauses if one is long enough. If most sweeps come in short groups,
    bursts are shorter: one group or several.

    Args:
        is_motion_known: False if bursts cannot be compared; then only as many are returned as will be read.
    """
    sweeps = len(sweeps_ns)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(sweeps_ns) > PAUSE_NS) + 1, [sweeps]])
    in_company = np.diff(edges)[np.diff(edges) >= BURST_TRIOS].sum()
    length = min(BURST_TRIOS if 2 * in_company >= sweeps else _CLUMP_TRIOS, sweeps)
    wanted = -(-budget // length) * (_CHOICE if is_motion_known else 1)
    count = max(1, min(wanted, sweeps // length))
    middle = ((np.arange(count) + 0.5) * sweeps / count).astype(np.int64)
    # Move a burst into its stretch if it reaches beyond it.
    stretch = np.searchsorted(edges, middle, "right") - 1
    begin, end = edges[stretch], edges[stretch + 1]
    is_long = end - begin >= length
    first = np.clip(
        middle - length // 2, np.where(is_long, begin, 0), np.where(is_long, end, sweeps) - length
    )
    last = first + length - 1
    gaps_ns = np.diff(sweeps_ns, prepend=sweeps_ns[0], append=sweeps_ns[-1])
    # Half-way to the neighbouring sweeps: the index gives the log time of a sweep only to within a chunk.
    reach_ns = np.minimum(gaps_ns // 2, PAUSE_NS)
    spans = np.stack([sweeps_ns[first] - reach_ns[first], sweeps_ns[last] + reach_ns[last + 1]], axis=1)
    around = sweeps_ns[np.clip(middle[:, None] + [-1, 0, 1], 0, sweeps - 1)]
    return PossibleBursts(spans, around, length)


def choose_bursts(motion: BurstMotion, count: int) -> list[int]:
    """The `count` best bursts as a set, in order of time; all of them if there are no more."""
    classes = _classes(motion, count)
    possible, kinds = classes.shape
    if possible <= count:
        return list(range(possible))
    seen = np.zeros((kinds, int(classes.max()) + 1))
    left, places, chosen = np.ones(possible, bool), np.arange(possible), list[int]()
    for _ in range(count):
        known = seen[np.arange(kinds), np.maximum(classes, 0)]
        gain = np.where(classes >= 0, np.log1p(1 / (1 + known)), 0.0).sum(axis=1)
        # Ties are resolved by the largest distance in time from the chosen bursts.
        apart = np.abs(np.subtract.outer(places, chosen)).min(axis=1, initial=possible) / possible
        best = int(np.argmax(np.where(left, gain + _TIE * apart, -1.0)))
        chosen.append(best)
        left[best] = False
        there = np.flatnonzero(classes[best] >= 0)
        seen[there, classes[best, there]] += 1
    return sorted(chosen)


def _classes(motion: BurstMotion, count: int) -> Int64[np.ndarray, "M 4"]:
    """Class of each burst in time, speed, turn and place; -1 if unknown."""
    possible, unknown = len(motion), np.isnan(motion)
    time = np.arange(possible) * count // max(possible, 1)
    speed = np.searchsorted(_SPEEDS_MPS, np.abs(motion[:, 0]))
    turn = np.searchsorted(_YAW_RATES_RADPS, motion[:, 1])
    cell = np.floor(np.nan_to_num(motion[:, 2:]) / _PLACE_M)
    place = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)
    classes = np.stack([time, speed, turn, place], axis=1).astype(np.int64)
    classes[:, 1:][unknown[:, :3]] = -1  # of a place, x and y are known or neither
    return classes
