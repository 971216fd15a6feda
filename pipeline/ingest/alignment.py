"""Radar misalignment messages of a day, summarised as one estimate per radar for the manifest."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from pipeline.errors import LogError
from pipeline.ingest.index import DayIndex
from pipeline.ingest.messages.alignment import SIGNS_PUBLISHED, Misalignment, read_alignment
from pipeline.ingest.messages.decoding import DECODE_ERRORS
from pipeline.ingest.roles import ALIGNMENT, Role
from pipeline.rig.rig import Rig
from pipeline.rigs import RadarTopics

__all__ = ["day_alignments", "level_and_step"]

_MOST_MESSAGES = 300  # per topic, evenly spread: some drivers put the angles beside 800 detections
_LEAST_STEP_RAD = np.radians(0.1)  # best accuracy of a day's radar yaw
_STEP_SIGMAS = 5.0
_FEWEST = 3  # fewest messages on either side of a step


def day_alignments(index: DayIndex, rig: Rig) -> dict[str, dict[str, Any]]:
    """Columns of table `radar_alignments` by radar, for radars with a usable message.

    Unreadable messages are counted and reported with file, topic and field.
    """
    found = {name: _of_radar(index, name, radar) for name, radar in rig.radars.items() if radar.alignment}
    return {name: columns for name, columns in found.items() if columns["messages"]}


def level_and_step(
    values: Float[np.ndarray, " N"],
) -> tuple[float, float, float | None, int]:
    """Level of a series of values, their scatter, and a possible step.

    Args:
        values: at least one, in order of time [rad].

    Returns:
        Median of the values after the step; robust sigma of single values; size of the step, None if none
        exceeds five sigmas and 0.1 deg; index of the first value after the step (0 without a step).
    """
    place, step, n = 0, None, len(values)
    if n >= 2 * _FEWEST:
        left = np.arange(_FEWEST, n - _FEWEST + 1)
        total = np.cumsum(values - values.mean())[left - 1]
        k = int(left[np.argmax(total**2 / (left * (n - left)))])  # least squares of two levels
        size = float(np.median(values[k:]) - np.median(values[:k]))
        noise = 1.4826 * float(np.median(np.abs(np.diff(values)))) / np.sqrt(2)
        sigma = noise * np.sqrt(np.pi / 2 * (1 / k + 1 / (n - k)))  # of medians
        if abs(size) > max(_STEP_SIGMAS * sigma, _LEAST_STEP_RAD):
            place, step = k, size
    level = float(np.median(values[place:]))
    scatter = 1.4826 * float(np.median(np.abs(values[place:] - level)))
    return level, scatter, step, place


def _of_radar(index: DayIndex, name: str, radar: RadarTopics) -> dict[str, Any]:
    said = _messages(index, name, radar)
    stamps_ns = np.array([stamp for stamp, _ in said], np.int64)
    angles = [(m.azimuth_rad, m.elevation_rad) for _, m in said]
    types = {at.channel.msgtype for at in index.stream(Role(ALIGNMENT, name)).located}
    without = sum(pair == (None, None) for pair in angles)
    columns: dict[str, Any] = {
        "topics": list(radar.alignment),
        "messages": len(said) - without,
        "without_angle": without,
        "sign_is_published": radar.alignment_fields is not None or types <= SIGNS_PUBLISHED,
        "statuses": dict(Counter(m.status for _, m in said if m.status)),
    }
    if len(said) == without:
        return columns
    columns |= {"first_stamp_ns": int(stamps_ns[0]), "last_stamp_ns": int(stamps_ns[-1])}
    steps = [
        _axis(
            columns,
            axis,
            stamps_ns,
            [(getattr(m, f"{axis}_rad"), getattr(m, f"{axis}_sigma_rad")) for _, m in said],
        )
        for axis in ("azimuth", "elevation")
    ]
    size, stamp_ns = max(steps)
    return columns | ({"step_stamp_ns": stamp_ns} if size else {})


def _axis(
    columns: dict[str, Any],
    axis: str,
    stamps_ns: Int64[np.ndarray, " N"],
    said: list[tuple[float | None, float | None]],
) -> tuple[float, int]:
    """Fill in the columns of one axis; returns size and stamp of its step, 0 and 0 without one."""
    known = np.array([angle is not None for angle, _ in said])
    if not known.any():
        return 0.0, 0
    values = np.array([angle for angle, _ in said if angle is not None])
    level, scatter, step, place = level_and_step(values)
    after = [sigma for angle, sigma in said if angle is not None][place:]
    sigmas = [sigma for sigma in after if sigma is not None]
    columns[f"{axis}_rad"], columns[f"{axis}_scatter_rad"] = level, scatter
    columns[f"{axis}_sigma_rad"] = float(np.median(sigmas)) if sigmas else None
    columns[f"{axis}_step_rad"] = step
    return (0.0, 0) if step is None else (abs(step), int(stamps_ns[known][place]))


def _messages(index: DayIndex, name: str, radar: RadarTopics) -> list[tuple[int, Misalignment]]:
    """Stamps and contents in order of stamps, at most a few hundred per topic."""
    stream = index.stream(Role(ALIGNMENT, name))
    of_topic: dict[str, list[int]] = {}
    for place in np.argsort(stream.stamps_ns, kind="stable").tolist():
        of_topic.setdefault(stream.located[place].channel.topic, []).append(place)
    found = []
    for places in of_topic.values():
        picked = np.unique(np.linspace(0, len(places) - 1, _MOST_MESSAGES).round().astype(int))
        for place in (places[k] for k in picked):
            located = stream.located[place]
            try:
                data = index.read(located)
                found.append(
                    (stream.stamps[place], read_alignment(located.channel, data, radar.alignment_fields))
                )
            except (LogError, *DECODE_ERRORS) as err:
                index.damage["alignment_unusable"] += 1
                index.complain(f"{index.log_names[located.log]}: {err}")
    return sorted(found, key=lambda pair: pair[0])
