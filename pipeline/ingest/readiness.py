"""Readiness: classes of DoF that logs can calibrate, per pair, missing data, and topics without a message."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher

from pipeline.ingest.index import ACCEPTED_TYPES, DayIndex
from pipeline.ingest.reasons import because
from pipeline.ingest.roles import INFO, NEEDED, TF_STATIC, Role, topics_of
from pipeline.rig.rig import Rig
from schemas.observations import WITHOUT_LABELS

__all__ = ["DofVerdict", "Evidence", "Unheard", "in_order", "judge_edge", "overall", "unheard_topics"]

# 30 frames give camera-lidar within 0.1 deg and lidar-radar yaw within 0.15 deg on real logs; 10 give twice
# that.
_ENOUGH_FRAMES, _FEW_FRAMES = 30, 10
_MOVING_SHARE = 0.2  # time offsets are observable only while the car moves
_ORDER = ("camera_lidar", "lidar_radar", "camera_radar")  # display order; other kinds come after these
_DENSE_RINGS = 32  # with fewer rings, pitch depends on reflectivity of the road
_SHOWN = 4  # similar topics named in a sentence
_MISTYPED = 0.8  # similarity of a mistyped name; other images, for example, are no labels


@dataclass(frozen=True)
class Unheard:
    """A topic without a message of a type that its role accepts.

    Args:
        types: types of its messages; empty without messages.
        others: topics of the logs with an accepted type that the rig does not name, the most similar first.
        is_shown: True for a CameraInfo whose images are there.
    """

    topic: str
    role: Role
    types: tuple[str, ...]
    others: tuple[str, ...]
    is_shown: bool = False

    @property
    def is_misconfigured(self) -> bool:
        """Whether fleet.toml or the recording must be corrected; else the sensor may only be silent."""
        return bool(self.types or self.others) or self.is_shown

    @property
    def problem(self) -> str:
        """Problem and correction, without the topic."""
        wanted = ACCEPTED_TYPES[self.role.what]
        what = because("no message")
        if self.types:
            what = because("type", types=", ".join(self.types), wanted=" or ".join(wanted))
        if set(self.types) & set(wanted):
            return because("no intrinsics", remedy=because("CameraInfo"))
        if self.others:
            return because("elsewhere", reason=what, topics=", ".join(self.others[:_SHOWN]))
        if self.is_shown:
            return f"{what}: {because('CameraInfo')}"
        return because("correct", reason=what) if self.types else what

    def __str__(self) -> str:
        return f"{self.topic} ({self.role}): {self.problem}"


@dataclass(frozen=True)
class Evidence:
    """Facts that a verdict is based on; shares are of the sampled frames, and meaningless without frames.

    `missing` has the topics without usable messages (none, or of another type) by sensor. Without
    `names_semantics`, fleet.toml has a camera and no source of its labels and road users.
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
    doppler_is_wrong: bool = False  # its sign or unit is certainly wrong and must be corrected first
    wrong: tuple[str, ...] = ()  # other sources of motion and directions that are certainly wrong
    missing: tuple[str, ...] = ()
    names_semantics: bool = True
    has_odometry: bool = False


@dataclass(frozen=True)
class DofVerdict:
    """Whether a class of DoF can be calibrated: "yes", "weak" (the prior provides part of it) or "no"."""

    pair: str
    dof: str
    verdict: str
    reasons: list[str] = field(default_factory=list)


def in_order(kind: str) -> int:
    """Position of an edge's kind in the display order."""
    return _ORDER.index(kind) if kind in _ORDER else len(_ORDER)


def judge_edge(name: str, kind: str, evidence: Evidence) -> list[DofVerdict]:
    """One verdict per class of DoF of an edge, from facts on its two sensors."""
    if "radar" not in kind and evidence.has_odometry:  # which moves these sensors, whatever a Doppler shows
        evidence = replace(evidence, doppler_problem="", doppler_is_wrong=False)
    needs = [(dof, needs) for of, dof, needs in _needs(evidence) if of == kind]
    return [
        _verdict(name, dof, needs if evidence.frames else _without_frames(evidence)) for dof, needs in needs
    ]


def _needs(evidence: Evidence) -> list[tuple[str, str, _Needs]]:
    """Unmet requirements of each pair and class of DoF."""
    e, camera, ground = evidence, _camera_needs(evidence), _common_needs(evidence)
    radar = [("weak", e.doppler_problem)] if e.doppler_problem and not e.doppler_is_wrong else []
    pitch = ground + camera
    if not (e.has_intensity or e.rings >= _DENSE_RINGS):
        pitch += [("weak", because("few rings"))]
    tilt = ground + radar + _elevation_needs(evidence)
    moving = ground + _moving_needs(evidence)
    boxes = camera
    if not e.names_semantics:
        boxes = [*camera, ("no", because("no boxes"))]
    shift = [("weak", because("shift"))]
    return [
        ("camera_lidar", "yaw and roll", ground + camera),
        ("camera_lidar", "pitch", pitch),
        ("camera_lidar", "translation", ground + camera + shift),
        ("camera_lidar", "time offset", moving + camera),
        ("lidar_radar", "yaw, x and y", ground + radar),
        ("lidar_radar", "roll, pitch and z", tilt + camera),
        ("lidar_radar", "time offset", moving + radar),
        ("camera_radar", "yaw", ground + boxes + radar),
        ("camera_radar", "roll and pitch", tilt + boxes),
        ("camera_radar", "translation", ground + boxes + radar + shift),
        ("lidar_lidar", "roll, pitch and yaw", ground),
        ("lidar_lidar", "translation", ground),
        ("lidar_lidar", "time offset", moving),
        ("lidar_base", "roll, pitch and z", ground),
        ("lidar_base", "yaw", moving),
        ("lidar_base", "x and y", ground + [("weak", because("turns, shift"))]),
        ("radar_base", "yaw", moving + radar),
        ("radar_base", "pitch", moving + radar + _elevation_needs(evidence)),
        ("camera_base", "yaw and pitch", moving),
        ("camera_base", "roll", [*moving, ("weak", because("turns, roll"))]),
    ]


def overall(verdicts: list[DofVerdict]) -> str:
    """Answer: "no" if every DoF is "no", "partly" if one is, "weak" if some edge has no "yes", else "yes"."""
    words = [v.verdict for v in verdicts]
    if "no" in words:
        return "no" if set(words) == {"no"} else "partly"
    return "yes" if {v.pair for v in verdicts} == {v.pair for v in verdicts if v.verdict == "yes"} else "weak"


_Needs = list[tuple[str, str]]


def _without_frames(e: Evidence) -> _Needs:
    """Without frames only the reason: prior, labels and motion are unknown."""
    why = e.missing or (because("too few", frames=0, needed=_FEW_FRAMES),)
    return [("no", because("no frames", reason="; ".join(why)))]


def _common_needs(e: Evidence) -> _Needs:
    needs: _Needs = [("no", e.doppler_problem)] if e.doppler_is_wrong else []
    needs += [("no", what) for what in e.wrong]
    if e.frames < _FEW_FRAMES:
        needs.append(("no", because("too few", frames=e.frames, needed=_FEW_FRAMES)))
    elif e.frames < _ENOUGH_FRAMES:
        needs.append(("weak", because("few", frames=e.frames, needed=_ENOUGH_FRAMES)))
    if not e.has_prior:
        needs.append(("no", because("no prior")))
    return needs


def _camera_needs(e: Evidence) -> _Needs:
    if not e.names_semantics:
        return [("weak", because("no semantics", without=WITHOUT_LABELS))]
    if e.labels_share == 0:
        return [("no", because("no labels"))]
    return [("weak", because("some labels", share=e.labels_share))] if e.labels_share < 0.5 else []


def _elevation_needs(e: Evidence) -> _Needs:
    if e.elevation_share < 0.5:
        return [("no", because("no elevation"))]
    if e.detections_share < 0.5:
        return [("weak", because("no detections"))]
    return [("weak", because("elevation"))]


def _moving_needs(e: Evidence) -> _Needs:
    if e.moving_share is None:
        return [("weak", because("motion unknown"))]
    if e.moving_share < _MOVING_SHARE:
        return [("no", because("stands", share=e.moving_share))]
    return []


def _verdict(pair: str, dof: str, needs: _Needs) -> DofVerdict:
    worst = "no" if any(n[0] == "no" for n in needs) else "weak" if needs else "yes"
    return DofVerdict(
        pair, dof, worst, list(dict.fromkeys(reason for level, reason in needs if level == worst))
    )


def unheard_topics(index: DayIndex, rig: Rig) -> list[Unheard]:
    """Topics of the rig without a usable message: those that it needs, and others that a similar topic replaces.

    Transforms are not among them: a prior file may take their place.
    """
    found, named = list[Unheard](), topics_of(rig)
    for topic, role in named.items():
        wanted, types = set(ACCEPTED_TYPES[role.what]), set(index.types_of(topic))
        is_shown = role.what == INFO and bool(index.captures(role.sensor).stamps)
        is_blind = is_shown and not index.cameras.get(role.sensor)
        if role == TF_STATIC or (wanted & types and not is_blind):
            continue
        alike = {name: SequenceMatcher(None, topic, name).ratio() for name, kind in index.types_beside
                 if kind in wanted and name not in named}  # fmt: skip
        others = sorted(alike, key=lambda name: (-alike[name], name))
        if role.what not in NEEDED:
            others = [name for name in others if alike[name] >= _MISTYPED]
            if not (others or types):
                continue
        found.append(Unheard(topic, role, tuple(sorted(types)), tuple(others), is_shown))
    return found
