"""Content of the page of one vehicle-day, from its records: plain values for the template, no HTML."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report.words import (
    ANSWERS,
    LEFT_OUT,
    dof_title,
    kind_of_sensor,
    motion_in_words,
    scaled,
    unit_of,
)
from pipeline.rig.se3 import change_between, change_covariance
from pipeline.store.corrections import correction_steps
from pipeline.store.current import prior_of, transform_of
from pipeline.store.partitions import Lake
from schemas.calibrations import DOF_NAMES, CalibrationRecord
from schemas.drift import DriftFinding, next_step, status_of
from schemas.faults import in_words
from schemas.poses import PoseRow
from schemas.words import RECORD_WORDS

__all__ = [
    "Answered",
    "answer_for",
    "answered",
    "clearest_alarm",
    "pair_view",
    "sigmas_of",
    "status_sentence",
]

_SAID_BY_THE_AXES = "not determined by the day"  # the page lists those axes by name


def sigmas_of(record: CalibrationRecord) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Sigmas (rotation [rad], origin [m]) of the prior and of the estimate; None if there is none."""
    T_prior, T = prior_of(record), transform_of(record)
    prior = None
    if T_prior is not None and record.prior_covariance is not None:
        # The prior's covariance is stated about the sensor itself, without a lever arm.
        prior = np.sqrt(np.diag(record.prior_covariance))
    if T is None or record.covariance is None:
        return prior, None
    return prior, np.sqrt(np.diag(change_covariance(T, record.covariance)))


def pair_view(record: CalibrationRecord) -> dict[str, Any]:
    """Content of the page about one edge, by name."""
    T, T_prior, ends = transform_of(record), prior_of(record), (record.parent_frame, record.child_frame)
    prior_sigma, sigma = sigmas_of(record)
    observable = record.observable or [sigma is not None] * 6
    change = change_between(T_prior, T) if T is not None and T_prior is not None else None
    unseen = [dof_title(record.pair, d) for d, o in zip(DOF_NAMES, observable, strict=True) if not o]
    quaternion = [record.qw, record.qx, record.qy, record.qz]
    translation = [record.tx_m, record.ty_m, record.tz_m]
    triggers = sorted({*record.trigger_before, *record.trigger_after})
    reasons = [part for part in record.reason.split("; ") if not part.startswith(_SAID_BY_THE_AXES)]
    return {
        "pair": "_".join(ends),  # as T_PAIR has it
        "title": "-".join(ends),
        "sensors": ends,
        "status": record.status,
        "advice": RECORD_WORDS[record.status],
        "reason": "; ".join(reasons),
        "faults": in_words(record.faults or ()),
        "known_to": _known_to(record.pair, sigma, observable),
        "undetermined": ", ".join(unseen) if sigma is not None else "",
        "moved_by": _moved_by(change),
        "rows": [
            {
                "name": dof_title(record.pair, dof),
                "unit": unit_of(dof),
                "prior": "" if T_prior is None or k < 3 else f"{T_prior[k - 3, 3]:+.3f}",
                "change": "" if change is None else f"{scaled(change[k], dof):+.3f}",
                "sigma": "" if sigma is None else f"{scaled(sigma[k], dof):.3f}",
                "prior_sigma": "" if prior_sigma is None else f"{scaled(prior_sigma[k], dof):.3f}",
                "observability": ""
                if record.observability is None
                else f"{100 * record.observability[k]:.0f} %",
                "observable": observable[k],
            }
            for k, dof in enumerate(DOF_NAMES)
        ],
        "matrix": "" if T is None else "\n".join("".join(f"{v:12.6f}" for v in row) for row in T),
        "quaternion": ", ".join(f"{v:.7f}" for v in quaternion if v is not None),
        "translation": ", ".join(f"{v:.4f}" for v in translation if v is not None),
        "json_text": _json_text(record, T),
        "triggers": [
            (n, _number(record.trigger_before.get(n)), _number(record.trigger_after.get(n))) for n in triggers
        ],
        "alignment": _before_after(record.alignment_before, record.alignment_after),
        "frames": f"{record.frames_used} of {record.frames_total}",
        "rejected": [
            (LEFT_OUT.get(why, why.replace("_", " ")), n)
            for why, n in sorted(record.frames_rejected.items(), key=lambda kv: -kv[1])
            if n
        ],
        "time_offset": _time_offset(record),
        "loop": _loop(record),
        "certified": _certified(record),
        "mounting": _mounting(record),  # what of it holds for the mounting, beside the direction in the image
        "notes": [note for note in record.notes if not note.startswith(_SAID_BY_THE_AXES)],
        "assumptions": record.assumptions,
        "missing": record.drive_missing,
        "diagnostics": [(name, f"{value:.4g}") for name, value in sorted(record.diagnostics.items())],
    }


def _certified(record: CalibrationRecord) -> str:
    """Directions that an accepted record certifies, and the margin of its checks; empty if it was never judged."""
    if record.score is None or record.limit_rad is None:
        return ""
    limits = {
        "azimuth": record.limit_rad,
        "elevation": record.diagnostics.get("elevation_limit_rad", record.limit_rad),
    }
    same = len({limits[name] for name in record.determined}) == 1
    each = [f"{name} within {np.degrees(limits[name]):.2g} deg" for name in record.determined]
    together = f"{' and '.join(record.determined)} within {np.degrees(record.limit_rad):.2g} deg"
    where = "at 15 to 40 m" + (", in the image with this CameraInfo" * record.pair.startswith("camera"))
    what = f"{together if same else ' and '.join(each)} {where}"
    margin = f"closest check: margin {record.score:.2f} (1 = far inside its limit, 0 = at the limit)"
    return f"{what if record.determined else 'nothing'}; {margin}"


def _mounting(record: CalibrationRecord) -> str:
    """Directions of the mounting that the record certifies, with their probability; empty if it was never judged."""
    if record.score is None or record.limit_rad is None:
        return ""
    azimuth, elevation = record.mounting_azimuth_sigma_rad, record.mounting_elevation_sigma_rad
    if azimuth is None or elevation is None:
        return "not certified: give the sigma of CameraInfo's principal point (centre_sigma_px)"
    certified = " and ".join(record.mounting_determined) or "not"
    known = f"{np.degrees(azimuth):.2f} deg of azimuth and {np.degrees(elevation):.2f} deg of elevation"
    return (
        f"{certified} certified; sigma {known}, including the uncertainty of CameraInfo's principal point. "
        "Use this sigma for geometry in the car's axes, and the sigma above for projections into this image"
        if record.pair.startswith("camera")
        else f"{certified} certified; sigma {known}"
    )


@dataclass(frozen=True)
class Answered:
    """A sensor or an edge in the page's first sentence; `certified` names its directions, in any text."""

    title: str
    status: str
    sensors: tuple[str, ...]
    certified: str


def answered(edges: Sequence[Answered], poses: Sequence[PoseRow]) -> Sequence[Answered]:
    """Sensors if the day has poses of them, without the reference; else edges."""
    return [
        Answered(p.sensor, p.status, (p.sensor,), ", ".join(p.determined))
        for p in poses
        if p.sensor != p.reference
    ] or edges


def answer_for(
    views: Sequence[Answered], day: str, findings: Sequence[DriftFinding], loaded: Sequence[Answered] = ()
) -> tuple[str, str]:
    """The headline of the page: (good, partly or bad; a sentence) on whether these numbers may be used on the car.

    Args:
        views: the day's edges, or its sensors.
        findings: the vehicle's current findings.
        loaded: sensors of tonight's state, if the page shows it: the answer is then on the state.
    """
    accepted = [v.title for v in views if v.status == "accepted"]
    other = [v.title for v in views if v.status != "accepted"]
    stored = status_of(findings)
    sensor = stored.sensor if stored.status == "RED" else None
    touched = [v.title for v in views if sensor in v.sensors]
    about = {"sensor": sensor, "since": stored.since}
    if (stored.since or "") > day and set(touched) & set(accepted):
        left = ", ".join(t for t in accepted if t not in touched)
        still = ANSWERS["moved since, others"].format(titles=left) if left else ""
        return "bad", ANSWERS["moved since"].format(**about) + still
    if loaded:
        return _of_state(loaded)
    titles = ", ".join(accepted)
    if unsafe := ", ".join(t for t in other if t in touched):
        first = ANSWERS["moved, accepted"].format(titles=titles) if accepted else "No."
        return "bad", ANSWERS["moved"].format(first=first, titles=unsafe, **about)
    if not accepted:
        return "bad", ANSWERS["nothing"]
    if not other:
        what = "pairs" if any(len(v.sensors) > 1 for v in views) else "sensors"
        return "good", ANSWERS["all"].format(what=what) + _one_direction(views)
    return "partly", ANSWERS["partly"].format(titles=titles, others=", ".join(other)) + _one_direction(views)


def _of_state(loaded: Sequence[Answered]) -> tuple[str, str]:
    """The headline of a page that shows tonight's state: what of it is certified, used, and at the prior."""
    certified = [s for s in loaded if s.status == "current" and s.certified]
    used = [s.title for s in loaded if s.status == "current" and not s.certified]
    at_prior = [s.title for s in loaded if s.status != "current"]
    if not certified:
        return "bad", ANSWERS["state, nothing"]
    in_one = _one_direction(certified)
    if not used and not at_prior:
        return "good", ANSWERS["state, all in one" if in_one else "state, all"] + in_one
    of = {"state, partly": [s.title for s in certified], "used": used, "at prior": at_prior}
    words = [ANSWERS[key].format(titles=", ".join(titles)) for key, titles in of.items() if titles]
    return "partly", "".join([*words, in_one])


def _one_direction(views: Sequence[Answered]) -> str:
    """Sentences on what is used and certified in one direction only; empty if there is nothing."""
    used = [v for v in views if v.status in ("accepted", "current")]
    words = ""
    for one, other in (("azimuth", "elevation"), ("elevation", "azimuth")):
        of = ", ".join(v.title for v in used if one in v.certified and other not in v.certified)
        words += ANSWERS["in one"].format(one=one, titles=of) if of else ""
    return words


def status_sentence(findings: Sequence[DriftFinding], lake: Lake, mend: str = "") -> tuple[str, str]:
    """The vehicle's stored status, its reason as a sentence, the motion of a sensor that moved, and what to do.

    Args:
        lake: named in the commands of the next step.
        mend: what must be corrected first, if anything.
    """
    stored = status_of(findings)
    sentence = f"{stored.reason[:1].upper()}{stored.reason[1:]}."
    moved = clearest_alarm(findings)
    if moved is not None and moved.moved_sensor is not None:
        kind = kind_of_sensor(moved.moved_sensor, findings)
        motion = motion_in_words(kind, moved.moved_motion or [], moved.moved_motion_sigma or [])
        sentence = f"{sentence} Its motion: {motion}."
    steps = correction_steps({findings[0].vehicle: mend}) if findings and mend else []
    if not (steps and stored.status == "UNKNOWN"):
        steps += [step] if (step := next_step(findings, str(lake.absolute()))) else []
    return stored.status, " ".join([sentence, *(f"To do for {step}" for step in steps)])


def clearest_alarm(findings: Sequence[DriftFinding]) -> DriftFinding | None:
    """The chart that determines the vehicle's stored status; None if no sensor moved."""
    stored = status_of(findings)
    wanted = (stored.status, stored.sensor, stored.since)
    rests_on = [f for f in findings if stored.since and (f.status, f.moved_sensor, f.start_day) == wanted]
    return max(rests_on, key=lambda f: (f.statistic or 0.0) / (f.threshold or 1.0), default=None)


def _known_to(pair: str, sigma: np.ndarray | None, observable: Sequence[bool]) -> str:
    if sigma is None:
        return "nothing was computed"
    parts = []
    for name, index in (("rotation", range(3)), ("position", range(3, 6))):
        seen = [k for k in index if observable[k]]
        if seen:
            worst = max(seen, key=lambda k: sigma[k])
            text = f"{scaled(sigma[worst], DOF_NAMES[worst]):.2g} {unit_of(DOF_NAMES[worst])}"
            parts.append(f"{name} {text} ({dof_title(pair, DOF_NAMES[worst])})")
    return ", ".join(parts) or "no degree of freedom"


def _moved_by(change: np.ndarray | None) -> str:
    if change is None:
        return ""
    angle, shift = np.degrees(np.linalg.norm(change[:3])), np.linalg.norm(change[3:])
    return f"{angle:.2f} deg and {100 * shift:.1f} cm from the prior"


def _before_after(before: float | None, after: float | None) -> str:
    if before is None and after is None:
        return ""
    return (
        f"{_number(before) or 'not computed'} at the prior, {_number(after) or 'not computed'} at the result"
    )


def _time_offset(record: CalibrationRecord) -> str:
    if record.time_offset_s is None:
        return ""
    sigma = "" if record.time_offset_sigma_s is None else f" ± {1e3 * record.time_offset_sigma_s:.1f}"
    parent, child = record.parent_frame, record.child_frame
    return f"{1e3 * record.time_offset_s:+.1f}{sigma} ms ({parent} stamp = {child} stamp + this)"


def _loop(record: CalibrationRecord) -> str:
    if record.loop_rotation_rad is None:
        return ""
    degrees = float(np.degrees(1.0))
    angle = f"{_with_sigma(record.loop_rotation_rad, record.loop_rotation_sigma_rad, degrees, 2)} deg"
    if record.loop_translation_m is None:
        return f"{angle} (rotations only)"
    return f"{angle}, {_with_sigma(record.loop_translation_m, record.loop_translation_sigma_m, 100.0, 1)} cm"


def _with_sigma(value: float, sigma: float | None, scale: float, digits: int) -> str:
    return f"{scale * value:.{digits}f}" + ("" if sigma is None else f" ± {scale * sigma:.{digits}f}")


def _json_text(record: CalibrationRecord, T: np.ndarray | None) -> str:
    if T is None:
        return ""
    fields = {
        "vehicle": record.vehicle, "day": record.day, "method": record.method, "pair": record.pair,
        "status": record.status, "parent_frame": record.parent_frame, "child_frame": record.child_frame,
        "qw": record.qw, "qx": record.qx, "qy": record.qy, "qz": record.qz,
        "tx_m": record.tx_m, "ty_m": record.ty_m, "tz_m": record.tz_m,
        "T": T.tolist(), "covariance": None if record.covariance is None else record.covariance.tolist(),
        "observable": record.observable, "work_key": record.work_key,
    }  # fmt: skip
    return json.dumps(fields)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
