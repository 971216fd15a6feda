"""From what logs hold to what they can calibrate, per pair and class of DoF, and what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

__all__ = ["DofVerdict", "Evidence", "in_order", "judge", "judge_edge", "overall"]

# 30 frames give camera-lidar within 0.1 deg and lidar-radar yaw within 0.15 deg on real logs, 10 twice that.
_ENOUGH_FRAMES, _FEW_FRAMES = 30, 10
_MOVING_SHARE = 0.2  # time offsets show only where the car moves
_ORDER = ("camera_lidar", "lidar_radar", "camera_radar")  # in which they are shown, other kinds behind
_DENSE_RINGS = 32  # below, reflectivity on the road has to carry pitch


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on; shares are of the frames looked at, and say nothing where there are none.

    `missing` names the topics without which a sensor is silent: no message of theirs, or of another type. `frames_of`
    counts by pair of the rig the frames that have both sensors; None = all have all.
    """

    frames: int
    has_prior: bool
    labels_share: float
    detections_share: float
    has_intensity: bool
    rings: int
    elevation_share: float
    moving_share: float | None
    doppler_problem: str = ""
    doppler_is_wrong: bool = False  # its sign or unit surely is: to be mended before anything else
    wrong: tuple[str, ...] = ()  # other sources of motion and directions that surely are
    missing: tuple[str, ...] = ()
    frames_of: Mapping[str, int] | None = None


@dataclass(frozen=True)
class DofVerdict:
    """Whether a class of DoF can be calibrated: "yes", "weak" (the prior carries part of it) or "no"."""

    pair: str
    dof: str
    verdict: str
    reasons: list[str] = field(default_factory=list)


def judge(evidence: Evidence) -> list[DofVerdict]:
    """One verdict per pair and class of DoF, the weakest of what it needs."""
    of_pair = dict.fromkeys(_ORDER, evidence.frames) if evidence.frames_of is None else evidence.frames_of
    return [
        verdict
        for pair in sorted(of_pair, key=_ORDER.index)
        for verdict in judge_edge(pair, pair, replace(evidence, frames=of_pair[pair]))
    ]


def in_order(kind: str) -> int:
    """Place of an edge's kind among those that are shown."""
    return _ORDER.index(kind) if kind in _ORDER else len(_ORDER)


def judge_edge(name: str, kind: str, evidence: Evidence) -> list[DofVerdict]:
    """One verdict per class of DoF of an edge, by what is known of its two sensors."""
    needs = [(dof, needs) for of, dof, needs in _needs(evidence) if of == kind]
    return [
        _verdict(name, dof, needs if evidence.frames else _without_frames(evidence)) for dof, needs in needs
    ]


def _needs(evidence: Evidence) -> list[tuple[str, str, _Needs]]:
    """What each pair and class of DoF needs and has not."""
    camera, radar, ground = _camera_needs(evidence), _radar_needs(evidence), _common_needs(evidence)
    pitch = ground + camera + _pitch_needs(evidence)
    tilt = ground + radar + _elevation_needs(evidence)
    moving = ground + _moving_needs(evidence)
    shift = [("weak", "far objects say little about shifts: the prior carries part of it")]
    return [
        ("camera_lidar", "yaw and roll", ground + camera),
        ("camera_lidar", "pitch", pitch),
        ("camera_lidar", "translation", ground + camera + shift),
        ("camera_lidar", "time offset", moving + camera),
        ("lidar_radar", "yaw, x and y", ground + radar),
        ("lidar_radar", "roll, pitch and z", tilt + camera),
        ("lidar_radar", "time offset", moving + radar),
        ("camera_radar", "yaw", ground + camera + radar),
        ("camera_radar", "roll and pitch", tilt + camera),
        ("camera_radar", "translation", ground + camera + radar + shift),
        ("lidar_lidar", "roll, pitch and yaw", ground),
        ("lidar_lidar", "translation", ground),
        ("lidar_lidar", "time offset", moving),
        ("lidar_base", "roll, pitch and z", ground),
        ("lidar_base", "yaw", moving),
        ("lidar_base", "x and y", ground + [("weak", "only turns say where the vehicle's x and y are")]),
        ("radar_base", "yaw", moving + radar),
        ("radar_base", "pitch", moving + radar + _elevation_needs(evidence)),
    ]


def overall(verdicts: list[DofVerdict]) -> str:
    """The answer for all: "no" where every DoF is, "yes" where none is, else "partly"."""
    refused = [v.verdict == "no" for v in verdicts]
    return "yes" if not any(refused) else "no" if all(refused) else "partly"


_Needs = list[tuple[str, str]]


def _without_frames(e: Evidence) -> _Needs:
    """Where no frame could be looked at, only why: nobody knows whether prior, labels or motion are there."""
    why = [("no", topic) for topic in e.missing] or [
        ("no", f"0 usable synchronised frames; at least {_FEW_FRAMES} are needed")
    ]
    return [*why, ("no", "so prior, labels and motion could not be judged")]


def _common_needs(e: Evidence) -> _Needs:
    needs: _Needs = [("no", e.doppler_problem)] if e.doppler_is_wrong else []
    needs += [("no", what) for what in e.wrong]
    if e.frames < _FEW_FRAMES:
        needs.append(("no", f"{e.frames} usable synchronised frames; at least {_FEW_FRAMES} are needed"))
    elif e.frames < _ENOUGH_FRAMES:
        needs.append(("weak", f"{e.frames} usable frames; {_ENOUGH_FRAMES} or more make it sharp"))
    if not e.has_prior:
        needs.append(("no", "no prior: log /tf_static with a chain between the sensors, or give prior.file"))
    return needs


def _camera_needs(e: Evidence) -> _Needs:
    if e.labels_share == 0:
        return [("no", "no semantic labels: log them, or name models (`boresight models fetch`)")]
    return [("weak", f"labels on {e.labels_share:.0%} of the frames only")] if e.labels_share < 0.5 else []


def _pitch_needs(e: Evidence) -> _Needs:
    if e.has_intensity or e.rings >= _DENSE_RINGS:
        return []
    return [("weak", "the lidar has few rings and logs no intensity: pitch rests on vertical edges alone")]


def _radar_needs(e: Evidence) -> _Needs:
    return [("weak", e.doppler_problem)] if e.doppler_problem and not e.doppler_is_wrong else []


def _elevation_needs(e: Evidence) -> _Needs:
    if e.elevation_share < 0.5:
        return [("no", "the radar measures no elevation: roll, pitch and z keep their prior")]
    if e.detections_share < 0.5:
        return [("weak", "no camera detections to hold against the radar's elevation")]
    return [("weak", "radar elevation is coarse: expect half a degree, and z from the prior")]


def _moving_needs(e: Evidence) -> _Needs:
    if e.moving_share is None:
        return [("weak", "whether the car moves could not be told from Doppler or odometry")]
    if e.moving_share < _MOVING_SHARE:
        return [("no", f"the car moves in {e.moving_share:.0%} of the frames: time offsets do not show")]
    return []


def _verdict(pair: str, dof: str, needs: _Needs) -> DofVerdict:
    worst = "no" if any(n[0] == "no" for n in needs) else "weak" if needs else "yes"
    return DofVerdict(
        pair, dof, worst, list(dict.fromkeys(reason for level, reason in needs if level == worst))
    )
