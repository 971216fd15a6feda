"""Selection of frames for fit and judgement, and reasons against the others.

The paper's conditions (section 4.5.1) per pair: camera-lidar needs sky, drivable area and road users;
camera-radar needs sky, road users and dynamic radar clusters; lidar-radar needs drivable area and dynamic
clusters. All need stamps within 5 ms, which the paper's methods keep even if ingest gates by motion. If too
few frames meet them, the nearest ones are added, with a note: a narrow camera may never see 20 % of sky. For
method `joint` the conditions are only counted; its frames are chosen to extend the coverage.

Coverage is of cells, intervals of azimuth, elevation and range. The hundredth edge in a cell adds less than the first,
so a set of frames is worth the sum over cells of log(1 + points); the frame that adds most comes next (submodular:
greedy is within 1 - 1/e of the best choice, Nemhauser et al. 1978).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.calibrate.numerics.frame_blocks import FEWEST_SCENES, scenes_of
from pipeline.calibrate.reasons import because
from pipeline.core.config import SelectConfig
from pipeline.core.errors import SolveError
from pipeline.objective.stamp_gaps import motion_gates_ns
from pipeline.rig.se3 import camera_direction_angles, to_spherical, transform_points
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS, SENSORS
from schemas.faults import FAULTS
from schemas.observations import Observation

__all__ = [
    "MIN_FRAMES", "PAPER_SYNC_GATE_S", "SHORTEST", "Selection", "hold_out", "missing_content",
    "select_frames", "unmet_conditions",
]  # fmt: skip

_AZIMUTH_RAD = np.radians([-35.0, -20.0, -7.0, 7.0, 20.0, 35.0])
_ELEVATION_RAD = np.radians([-6.0, -1.5, 1.5])
_RANGE_M = np.array([10.0, 20.0, 40.0])
_CELLS = (len(_AZIMUTH_RAD) + 1) * (len(_ELEVATION_RAD) + 1) * (len(_RANGE_M) + 1)
_SIDE_DEG, _FAR_M, _NEAR_M = 15.0, 40.0, 10.0
_HARDLY_ANY = 0.02  # of all points of a kind


@dataclass(frozen=True)
class _Kind:
    """Points of one kind that a pair is calibrated from."""

    name: str
    words: str
    camera_axes: bool = False  # seen from the camera by the prior; else from the sensor that measured them
    far: bool = True  # worth having beyond _FAR_M


_KINDS = {
    "camera_lidar": (
        _Kind("lidar_edge_xyz_m", "poles, signs or cars (depth edges)", camera_axes=True),
        _Kind("marking_xyz_m", "road markings", camera_axes=True, far=False),
    ),
    "camera_radar": (_Kind("radar_track_xyz_m", "moving road users"),),
    "lidar_radar": (
        _Kind("radar_xyz_m", "radar detections"),
        _Kind("radar_track_xyz_m", "moving road users"),
    ),
}


def _contents_of(observations: Sequence[Observation], pair: str) -> Float[np.ndarray, "F C"]:
    """Points of each frame in each cell, kinds one after another."""
    return np.array([np.concatenate([_cells(o, kind) for kind in _KINDS[pair]]) for o in observations])


def _most_informative(candidates: Sequence[int], contents: Float[np.ndarray, "F C"], count: int) -> list[int]:
    """Of each of `count` equal stretches of the candidates, the frame that adds most to those chosen before."""
    if len(candidates) <= count:
        return sorted(candidates)
    total, chosen = np.zeros(contents.shape[1]), []
    for stretch in np.array_split(np.array(sorted(candidates)), count):
        gain = (np.log1p(total + contents[stretch]) - np.log1p(total)).sum(axis=1)
        chosen.append(int(stretch[np.argmax(gain)]))
        total += contents[chosen[-1]]
    return chosen


def _missing_in_view(observations: Sequence[Observation], pair: str) -> list[str]:
    """Nearly empty parts of the view, in words."""
    missing = []
    for kind in _KINDS[pair]:
        views = [_seen(o, kind) for o in observations]
        azimuth, _, distance = np.concatenate(views).T if views else np.zeros((3, 0))
        if not len(azimuth):
            missing.append(because("drive where", what=kind.words))
            continue
        parts = {
            f"left of {_SIDE_DEG:.0f} deg": azimuth > np.radians(_SIDE_DEG),
            f"right of -{_SIDE_DEG:.0f} deg": azimuth < -np.radians(_SIDE_DEG),
            f"beyond {_FAR_M:.0f} m": (distance > _FAR_M) | (not kind.far),
            f"nearer than {_NEAR_M:.0f} m": distance < _NEAR_M,
        }
        empty = [where for where, there in parts.items() if there.mean() < _HARDLY_ANY]
        if empty:
            missing.append(because("drive where, some", what=kind.words, where=" and ".join(empty)))
    return missing


def _cells(observation: Observation, kind: _Kind) -> Float[np.ndarray, " C"]:
    azimuth, elevation, distance = _seen(observation, kind).T
    index = np.searchsorted(_AZIMUTH_RAD, azimuth)
    index = index * (len(_ELEVATION_RAD) + 1) + np.searchsorted(_ELEVATION_RAD, elevation)
    index = index * (len(_RANGE_M) + 1) + np.searchsorted(_RANGE_M, distance)
    return np.bincount(index, minlength=_CELLS).astype(float)


def _seen(observation: Observation, kind: _Kind) -> Float[np.ndarray, "N 3"]:
    """Azimuth, elevation [rad] and range [m]; for the camera only points ahead."""
    points = np.asarray(getattr(observation, kind.name), np.float64).reshape(-1, 3)
    o = observation
    if kind.camera_axes and "camera_lidar" in o.priors:
        points = transform_points(o.priors["camera_lidar"], points)
        points = points[points[:, 2] > 1.0]
        return np.column_stack([camera_direction_angles(points), np.linalg.norm(points, axis=1)])
    return to_spherical(points)


PAPER_SYNC_GATE_S = 0.005  # section 4.5.1

MIN_FRAMES = 8  # fewer are not accepted: 10 frames already scatter by 0.1 deg (evidence on the real logs)
# With so many, camera-lidar of method `joint` has a covariance (README); it is held.
SHORTEST = 5
# No method can use such a frame.
_HARD = frozenset({"sync", "empty", *(f"no_{sensor}" for sensor in SENSORS)})
_SCARCE, _BRISK_MPS = 0.1, 5.0
_BLOCKS_S = (10.0, 7.0, 5.0, 4.0, 3.0, 20.0)
_JUDGING_BLOCKS = 4
_GUARD_S = 1.0  # frames nearer in time than this show the same scene


@dataclass(frozen=True)
class Selection:
    """Row numbers of the observations per pair, in order of time, and the counts behind them."""

    fit: dict[str, list[int]]  # of pairs that have frames enough; the others are refused
    holdout: dict[str, list[int]]
    passed: dict[str, int]  # frames that meet the paper's conditions
    rejected: dict[str, dict[str, int]]  # frames not used for the fit, by reason
    notes: dict[str, list[str]] = field(default_factory=dict)
    missing: dict[str, list[str]] = field(default_factory=dict)  # what the day did not show, in words
    refused: dict[str, SolveError] = field(default_factory=dict)  # pairs with too few frames, and why


def select_frames(
    observations: Sequence[Observation], config: SelectConfig, *, paper: bool,
    sync_gate_s: float | None = PAPER_SYNC_GATE_S, motion_gate: tuple[float, float] | None = None,
    pairs: Sequence[str] = PAIRS, absent: Mapping[str, str] | None = None,
) -> Selection:  # fmt: skip
    """Choose frames for the fit and held-out frames for each pair, deterministically, from frames with both sensors.

    Args:
        paper: prefer frames that meet the paper's conditions; else choose by content alone.
        sync_gate_s: largest difference of a pair's stamps; None = any that ingest accepted.
        motion_gate: largest motion of the car [m, rad] between a pair's stamps, without their constant gap.
        absent: reasons why frames lack a sensor, by sensor, if known.
    """
    scene = scenes_of(observations)
    held_out = hold_out(observations, config.holdout_fraction, scene)
    fit, holdout, passed, rejected, notes, missing = {}, {}, {}, {}, {}, {}
    refused: dict[str, SolveError] = {}
    for pair in pairs:
        reasons = [unmet_conditions(o, pair, config, sync_gate_s) for o in observations]
        for i in [] if motion_gate is None else np.flatnonzero(_apart(observations, pair, *motion_gate)):
            reasons[i].append("sync")
        usable = [i for i, r in enumerate(reasons) if not _HARD & set(r)]
        judges = [i for i in usable if held_out[i] is True]
        candidates = _few_of_each([i for i in usable if held_out[i] is False], scene)
        silent = _silent(pair, observations, absent or {})
        least = SHORTEST if pair == "camera_lidar" and not paper and silent is None else MIN_FRAMES
        if len(candidates) < least == SHORTEST:  # too few to hold any out: all fit, and the record is held
            judges, candidates = [], _few_of_each(usable, scene)
        ideal = [i for i in candidates if not reasons[i]]
        contents = _contents_of(observations, pair)
        chosen = _most_informative(ideal if paper else candidates, contents, config.frames)
        if paper and len(chosen) < config.frames:
            rest = sorted(set(candidates) - set(chosen), key=lambda i: (len(reasons[i]), i))
            fewest = rest[: max(0, 2 * (config.frames - len(chosen)))]
            chosen = sorted(chosen + _most_informative(fewest, contents, config.frames - len(chosen)))
        rejected[pair] = _count_rejected(reasons, held_out, chosen, paper=paper)
        if len(chosen) < least:
            refused[pair] = silent or SolveError(_too_few(pair, chosen, reasons, least))
            continue
        fit[pair], holdout[pair] = chosen, judges
        passed[pair] = sum(1 for r in reasons if not r)
        notes[pair] = _notes(pair, passed[pair], [i for i in chosen if reasons[i]], len(chosen), paper=paper)
        missing[pair] = missing_content([observations[i] for i in chosen], pair)
    return Selection(fit, holdout, passed, rejected, notes, missing, refused)


def unmet_conditions(
    observation: Observation, pair: str, config: SelectConfig, sync_gate_s: float | None = PAPER_SYNC_GATE_S
) -> list[str]:
    """The paper's conditions that a frame does not meet for a pair, by name.

    "empty" if it has nothing to align; only "no_radar" and the like if it lacks a sensor.
    """
    camera, lidar, radar = (s in FRAMES_OF_PAIR[pair] for s in ("camera", "lidar", "radar"))
    first_ns, second_ns = _stamps_ns(observation, pair)
    clusters = len(observation.radar_track_xyz_m)
    unmet = {
        "sync": sync_gate_s is not None and abs(first_ns - second_ns) > sync_gate_s * 1e9,
        "sky": camera and observation.sky_fraction < config.min_sky,
        "drivable": lidar and observation.drivable_fraction < config.min_drivable,
        "road_users": camera and len(observation.road_user_boxes_px) < config.min_road_users,
        "radar_clusters": radar and clusters < config.min_radar_clusters,
        "empty": (lidar and not len(observation.lidar_map_xyz_m))
        or (radar and not len(observation.radar_xyz_m)),
    }
    absent = [f"no_{sensor}" for sensor in FRAMES_OF_PAIR[pair] if sensor not in observation.sensors]
    return absent or [name for name, is_unmet in unmet.items() if is_unmet]


def _apart(
    observations: Sequence[Observation], pair: str, move_m: float, turn_rad: float
) -> Bool[np.ndarray, " F"]:
    """Frames in which the car moved too far between a pair's captures.

    Ingest checks each sensor against the moment; two sensors of a large rig can be on either side of it.
    """
    speed, yaw_rate = (
        np.array([getattr(o, name) for o in observations], np.float64)
        for name in ("ego_speed_mps", "ego_yaw_rate_radps")
    )
    both = np.array([set(FRAMES_OF_PAIR[pair]) <= set(o.sensors) for o in observations], bool)
    gap_ns = np.array([np.subtract(*_stamps_ns(o, pair)) for o in observations], np.float64)
    beyond = np.abs(gap_ns - (np.median(gap_ns[both]) if both.any() else 0.0))
    return both & (beyond > motion_gates_ns(speed, yaw_rate, move_m, turn_rad))


def _stamps_ns(observation: Observation, pair: str) -> tuple[int, int]:
    """Stamps of a pair's two sensors."""
    o = observation
    of_kind = {"camera": o.camera_stamp_ns, "lidar": o.stamp_ns, "radar": o.radar_stamp_ns}
    first, second = FRAMES_OF_PAIR[pair]
    return of_kind[first], of_kind[second]


def missing_content(observations: Sequence[Observation], pair: str) -> list[str]:
    """Text with content that the chosen frames lack for a pair, and that the next drive should contain."""
    missing = []
    speeds = np.array([abs(o.ego_speed_mps) for o in observations if o.ego_speed_mps is not None])
    if len(speeds) and np.mean(speeds > _BRISK_MPS) < _SCARCE:
        missing.append(because("drive faster", speed=_BRISK_MPS))
    if "radar" in FRAMES_OF_PAIR[pair]:
        if np.mean([len(o.radar_track_xyz_m) > 0 for o in observations]) < _SCARCE:
            missing.append(because("drive, radar"))
        if not any(o.radar_has_elevation for o in observations):
            missing.append(because("no drive"))
    if (
        "camera" in FRAMES_OF_PAIR[pair]
        and not any(o.is_unlabelled for o in observations)
        and np.mean([len(o.road_user_boxes_px) > 0 for o in observations]) < _SCARCE
    ):
        missing.append(because("drive, camera"))
    if len(np.unique(scenes_of(observations))) < FEWEST_SCENES:
        missing.append(because("drive on"))
    return missing + _missing_in_view(observations, pair)


def _few_of_each(candidates: Sequence[int], scene: np.ndarray) -> list[int]:
    """At most MIN_FRAMES of a scene, evenly spread, because a wait at a light would outweigh the rest of the day."""
    kept = []
    for number in np.unique(scene[list(candidates)]):
        of_scene = [i for i in candidates if scene[i] == number]
        some = np.linspace(0, len(of_scene) - 1, min(len(of_scene), MIN_FRAMES)).astype(int)
        kept += [of_scene[k] for k in some]
    return sorted(kept)


def hold_out(
    observations: Sequence[Observation], fraction: float, scene: Int[np.ndarray, " F"] | None = None
) -> list[bool | None]:
    """Split a day into blocks of time: True = held out, False = fit, None = too near in time to a frame of the fit.

    Every k-th block is held out, so that both parts cover all of the day. Blocks never cross a drive, and a
    scene is in one block as a whole, with its first frame, even if the car returns to it. Of several lengths
    of block, the split is chosen that comes nearest to the fraction, loses few frames next to the fit, and
    holds out at least _JUDGING_BLOCKS blocks. A day of one scene is split within the scene; its held-out
    frames then prove nothing, and the record gives this as a reason.
    """
    if not observations:
        return []
    stamps = np.array([o.stamp_ns for o in observations]) * 1e-9
    drives = np.unique([o.drive for o in observations], return_inverse=True)[1].ravel()
    start = np.array([stamps[drives == d].min() for d in range(drives.max() + 1)])
    _, begins, scene = np.unique(
        scenes_of(observations) if scene is None else scene, return_index=True, return_inverse=True
    )
    begins = begins[scene.ravel()] if len(begins) > 1 else np.arange(len(stamps))
    best, best_score = np.zeros(len(stamps), int), np.inf
    for block_s in _BLOCKS_S:
        count = 1 + int((stamps - start[drives]).max() // block_s)
        block = drives * count + ((stamps - start[drives]) // block_s).astype(int)
        order = np.unique(block[begins], return_inverse=True)[1].ravel()
        for every in {max(2, round(1 / fraction) + step) for step in (-2, -1, 0)}:
            # The middle one of every k, so that a day of fewer than k blocks still holds one out.
            judges = order % every == min(every // 2, order.max())
            roles = np.where(judges, np.where(_near(stamps, stamps[~judges]), -1, 1), 0)
            blocks = len(np.unique(order[roles == 1]))
            score = 2 * abs(np.mean(roles == 1) - fraction) + np.mean(roles == -1)
            score += 0.1 * max(0, _JUDGING_BLOCKS - blocks)
            if score < best_score - 1e-9:
                best, best_score = roles, score
    return [None if role < 0 else bool(role) for role in best]


def _near(stamps: np.ndarray, others: np.ndarray) -> np.ndarray:
    """True if one of `others` is within _GUARD_S."""
    if not len(others):
        return np.zeros(len(stamps), bool)
    others = np.sort(others)
    k = np.searchsorted(others, stamps)
    before, after = others[np.maximum(k - 1, 0)], others[np.minimum(k, len(others) - 1)]
    return np.minimum(np.abs(stamps - before), np.abs(stamps - after)) < _GUARD_S


def _count_rejected(
    reasons: list[list[str]], held_out: list[bool | None], chosen: Sequence[int], *, paper: bool
) -> dict[str, int]:
    taken = set(chosen)
    counts: Counter[str] = Counter()
    for i, unmet in enumerate(reasons):
        if i in taken:
            continue
        hard = [r for r in unmet if r in _HARD]
        if hard:
            counts[hard[0]] += 1
        elif held_out[i] is not False:
            counts["held_out" if held_out[i] else "next_to_held_out"] += 1
        elif paper and unmet:
            counts[unmet[0]] += 1
        else:
            counts["not_needed"] += 1
    return dict(counts)


def _notes(pair: str, passed: int, below: Sequence[int], chosen: int, *, paper: bool) -> list[str]:
    if paper and below:
        return [because("below conditions", passed=passed, pair=pair, below=len(below), used=chosen)]
    return []


def _silent(pair: str, observations: Sequence[Observation], absent: Mapping[str, str]) -> SolveError | None:
    """Reason to refuse a pair with too few frames of a sensor, or None."""
    known = [absent[sensor] for sensor in FRAMES_OF_PAIR[pair] if sensor in absent]
    unlabelled = next((why for why in known if _fault_in(why) == "no_labels"), None)
    if unlabelled is not None and not any(set(FRAMES_OF_PAIR[pair]) <= set(o.sensors) for o in observations):
        return SolveError(unlabelled, fault="no_labels")
    if known and len(observations) < MIN_FRAMES:
        both = sum(set(FRAMES_OF_PAIR[pair]) <= set(o.sensors) for o in observations)
        told = because("few moments", both=both, needed=MIN_FRAMES, why=known[0])
        return SolveError(told, fault=_fault_in(known[0]))
    for sensor in FRAMES_OF_PAIR[pair]:
        seen = sum(sensor in o.sensors for o in observations)
        if seen < MIN_FRAMES <= len(observations):
            told = because(
                "few of a sensor", sensor=sensor, seen=seen, all=len(observations), needed=MIN_FRAMES
            )
            why = f" ({absent[sensor]})" if sensor in absent else ""
            return SolveError(told + why, fault=_fault_in(absent.get(sensor, "")))
    return None


def _fault_in(why: str) -> str:
    """The fault whose sentence is at the beginning of the text."""
    return next((code for code, sentence in FAULTS.items() if why.startswith(sentence)), "silent_sensor")


def _too_few(pair: str, chosen: Sequence[int], reasons: Sequence[Sequence[str]], fewest: int) -> str:
    counts: Mapping[str, int] = Counter(r for unmet in reasons for r in unmet)
    why = ", ".join(f"{name} {n}" for name, n in sorted(counts.items())) or because("no more")
    return because("few of a pair", pair=pair, used=len(chosen), all=len(reasons), needed=fewest, counts=why)
