"""Comparison of parts of camera-lidar's evidence: pitch and yaw from each part alone.

The fit takes their mean, and its sigma is as small as if they agreed. If a surface of the cloud has no border
in the labels (the sill of a car's window, whose nearest border is the roof), one kind of edge is biased by a
degree; halves and held-out frames do not show it, because they share the bias. If only some cars have windows
and there is no paint, the whole side follows the sills; only the difference between its low and its high
edges shows that.

Offsets of detected road users from the lidar's objects: evidence of a network other than the segmenter.

A lidar's object is projected by the pose; if exactly one box surrounds about the same part of the image, both
show one road user. A detector trained apart from the segmenter has other errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Float, Int, Int64

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.covariance import CLEARLY
from pipeline.calibrate.numerics.nuisances import (
    CAMERA_LIDAR_BIAS,
    EDGE_SIDE_MOST_OF_GAP,
    EDGE_SIDE_MOST_PX,
    PartTurn,
)
from pipeline.calibrate.reasons import because
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Check, change_of
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT, Observation

__all__ = ["box_offsets", "disagreement", "turn_numbers", "turns_by_parts"]

_REACH_RAD = np.radians(2.0)
_STEP_PX = 0.5  # of the label image
_RESAMPLES = 64
_FEWEST_BLOCKS = 8  # with fewer, frames are resampled: two blocks know no scatter
_FEWEST = 100  # edges, or markings, of a kind
_SIGMAS, _FLOORS = 2.0, 3.0  # by which two of them contradict: of both together
_PAINT_FLOOR_PX = 0.5  # on 34 good days of thirteen rigs paint is off by up to 0.4
# Medians over the boxes of eight good days of five rigs, at the true pose: pitch -.12 to -.30 deg, as the ground takes
# the objects' feet, yaw -.25 to +.02; the real car -.10 and .00, KITTI -.17 and .02.
_BOX_PITCH_RAD, _FEWEST_BOXES = float(np.radians(-0.18)), 20
# Beside its scatter, pitch by boxes errs by .05 deg on 51 days of eight rigs and by .10 on 34 of drawn worlds and rigs
# (`boxes_pitch_*` and errors of the lines in tests/benchmarks/results of 62eb5928).
_BOX_FLOOR_RAD: Final = tuple(np.radians((0.10, 0.15)).tolist())
# Those that see a turn about an axis (0 pitch, 1 yaw); a turn along an edge moves it within its border.
_SIDES: Final = {
    0: (("edges below a foreground", EDGE_ABOVE), ("edges above a foreground", EDGE_BELOW)),
    1: (("edges right of a foreground", EDGE_LEFT), ("edges left of a foreground", EDGE_RIGHT)),
}
_AXES: Final = ("pitch", "yaw")
_FIT: Final = "the fit"
_BOXES: Final = "boxes"
# Angle by which a metre of a road user's way moves it across the view [rad/m]: where it was between sweep and image is
# not known. Front cameras have .003 to .02. Of those that look aside, .02 to .2, yaw by boxes was up to 2.6 deg off at
# the true pose, and pitch .2 (four days of vans, seeds 7423, 7431).
_MOST_ACROSS_RADPM = 0.025
_FEWEST_POINTS = 12
_LEAST_PX = 12.0  # of a box, on either side, in the image of the labels' size
_BORDER_PX = 4.0  # nearer to the image's border a road user may be cut
_LEAST_OVERLAP = 0.3  # intersection over union; of the second best pairing at most half of that
_Boxes = Float[np.ndarray, "_ 4"]  # u0 v0 u1 v1


def turns_by_parts(
    observations: Sequence[Observation], terms: Terms, state: AlignmentState, kernel: KernelSettings,
    blocks: Int[np.ndarray, " F"], seed: int, fit_sigma_rad: Sequence[float],
) -> list[PartTurn]:  # fmt: skip
    """Rotations about camera x and y by each side of the edges, its halves, the markings, and detected boxes alone.

    Each score's maximum within 2 deg, other unknowns unchanged, and the boxes' median; sigmas by resampling
    blocks of frames, so that a score of several maxima is uncertain. The fit itself is included, with its
    sigmas of pitch and yaw.
    """
    px_rad = 1 / float(terms.camera[1])
    steps = int(_REACH_RAD / (_STEP_PX * px_rad))
    turn_rad = np.arange(-steps, steps + 1) * _STEP_PX * px_rad
    found = []

    def ask(name: str, axis: int, score: np.ndarray, floor_rad: float, part_of: str = "") -> None:
        rng = np.random.default_rng(seed)
        offset, scatter = _maximum(turn_rad, score.astype(np.float64), blocks, rng)
        found.append(PartTurn(name, offset, scatter, floor_rad, axis, part_of))

    for axis, sides in _SIDES.items():
        at = state.changed(turn_rad[:, None] * (np.arange(8) == axis))
        for name, side in sides:
            edges = terms.edges.chosen(terms.edges.side == side)
            if kernel.edge_weight <= 0 or len(edges.xyz_m) < _FEWEST:
                continue
            halves = {k: replace(terms, edges=half) for k, half in _by_height(edges).items()}
            scores = {k: half.edge_score(at, kernel) for k, half in halves.items()}
            ask(name, axis, sum(scores.values(), np.zeros(1)), _most_offset_rad(edges, px_rad))
            for k, half in halves.items():
                if len(half.edges.xyz_m) >= _FEWEST:
                    ask(f"{k} {name}", axis, scores[k], _most_offset_rad(half.edges, px_rad), name)
        if kernel.marking_weight > 0 and len(terms.markings.xyz_m) >= _FEWEST:
            ask("paint", axis, terms.marking_score(at, kernel), _PAINT_FLOOR_PX * px_rad)
    fit = [PartTurn(_FIT, 0.0, fit_sigma_rad[axis], float(CAMERA_LIDAR_BIAS[axis]), axis) for axis in _SIDES]
    return fit + found + _boxes(observations, terms.poses(state.alone)[0], terms.velocity_lidar, blocks, seed)


def _most_offset_rad(edges: Points, px_rad: float) -> float:
    """Largest plausible angle between jumps in range and boundaries of one side; `px_rad`: angle of a label pixel."""
    return float(np.hypot(EDGE_SIDE_MOST_PX * px_rad, EDGE_SIDE_MOST_OF_GAP * np.median(edges.gap_rad)))


def _by_height(edges: Points) -> dict[str, Points]:
    """Edges below and above their median height, in lidar axes."""
    is_high = edges.xyz_m[:, 2] > np.median(edges.xyz_m[:, 2])
    return {"low": edges.chosen(~is_high), "high": edges.chosen(is_high)}


def _boxes(
    observations: Sequence[Observation], poses: Float[np.ndarray, "F 12"],
    velocity_lidar: Float[np.ndarray, "F 3"], blocks: Int[np.ndarray, " F"], seed: int,
) -> list[PartTurn]:  # fmt: skip
    """Rotation of the solution by boxes of a detector, which are independent of the label maps.

    None of a camera that sees road users pass.
    """
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3] = poses.reshape(-1, 3, 4)
    frame, offset, centre = box_offsets(observations, T)
    way, far_m = (T[frame, :3, :3] @ velocity_lidar[frame][..., None])[..., 0], np.linalg.norm(centre, axis=1)
    sine = np.linalg.norm(np.cross(way, centre), axis=1) / np.maximum(
        np.linalg.norm(way, axis=1) * far_m, 1e-9
    )
    if len(frame) < _FEWEST_BOXES or np.median(sine / far_m) > _MOST_ACROSS_RADPM:
        return []
    offset[:, 0] -= _BOX_PITCH_RAD
    rng, of_block = np.random.default_rng(seed), blocks[frame]
    known = np.unique(of_block)
    rows = [np.flatnonzero(of_block == b) for b in known]
    drawn = rng.integers(len(known), size=(_RESAMPLES, len(known)))
    scatter = np.std([np.median(offset[np.concatenate([rows[b] for b in d])], axis=0) for d in drawn], axis=0)
    return [
        PartTurn(_BOXES, float(np.median(offset[:, axis])), float(scatter[axis]), _BOX_FLOOR_RAD[axis], axis)
        for axis in (0, 1)
    ]


def disagreement(turns: Sequence[PartTurn]) -> list[Check]:
    """A failed check for each axis about which two contradict each other; its error is the larger of their offsets.

    Sigma stays as it is: on known days half of the difference had nothing to do with the error, and a wider
    sigma let radars move poses that were right.
    """
    return [_failed(a, b) for a, b in _contradictions(turns)]


def _failed(a: PartTurn, b: PartTurn) -> Check:
    right, about = max(a, b, key=lambda w: abs(w.offset_rad)), np.arange(6) == a.axis
    return Check(
        because("parts", axis=_AXES[a.axis], a=a.sentence, b=b.sentence),
        "witnesses_disagree",
        error=change_of(about * right.offset_rad),
        covariance=np.diag(about * right.sigma_rad**2),
    )


def turn_numbers(turns: Sequence[PartTurn]) -> dict[str, float]:
    """Offsets and sigmas, for the record's diagnostics."""
    return {
        f"{w.name.replace(' ', '_')}_{_AXES[w.axis]}_{what}_rad": value
        for w in turns
        if w.name != _FIT and not w.part_of
        for what, value in (("offset", w.offset_rad), ("sigma", w.sigma_rad))
    }


def _contradictions(turns: Sequence[PartTurn]) -> list[tuple[PartTurn, PartTurn]]:
    """The two parts that differ most in each axis, if by more than two sigmas and three of their floors."""
    worst: dict[int, tuple[float, tuple[PartTurn, PartTurn]]] = {}
    for a, b in combinations(turns, 2):
        if _FIT in (a.name, b.name) and _BOXES not in (a.name, b.name):
            continue  # sides and paint are parts of the fit
        if a.part_of != b.part_of:
            continue
        apart = abs(a.offset_rad - b.offset_rad)
        least = max(
            _SIGMAS * float(np.hypot(a.sigma_rad, b.sigma_rad)),
            _FLOORS * float(np.hypot(a.floor_rad, b.floor_rad)),
        )
        if a.axis == b.axis and apart > max(least, worst.get(a.axis, (0.0,))[0]):
            worst[a.axis] = (apart, (a, b))
    return [pair for _, pair in worst.values()]


def _maximum(
    turn_rad: Float[np.ndarray, " P"],
    score: Float[np.ndarray, "P F"],
    blocks: Int[np.ndarray, " F"],
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Rotation at the highest score, and its scatter over resampled blocks [rad].

    The score of a maximum must exceed that of the fit by a few nats. Without paint the score is flat, and the
    same few points put its maximum 1 to 2 deg off in every resample (worlds whose lidar is blind to
    markings).
    """
    names, index = np.unique(blocks, return_inverse=True)
    if len(names) < _FEWEST_BLOCKS:
        index = np.arange(len(blocks))
    count = int(index.max()) + 1
    by_block = np.zeros((len(score), count))
    np.add.at(by_block.T, index, score.T)
    drawn = rng.multinomial(count, np.full(count, 1 / count), _RESAMPLES)
    best = turn_rad[np.argmax(by_block @ np.column_stack([np.ones(count), drawn.T]), axis=0)]
    # Of n blocks resamples scatter by (n - 1) / n too little.
    spread = np.sqrt(np.mean((best[1:] - best[0]) ** 2) * count / max(count - 1, 1))
    total = score.sum(1)
    if total.max() - total[np.argmin(np.abs(turn_rad))] < CLEARLY**2 / 2:
        spread = max(spread, abs(best[0]))
    return float(best[0]), float(spread)


def box_offsets(
    observations: Sequence[Observation], T_camera_lidar: Float[np.ndarray, "F 4 4"]
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, "M 2"], Float[np.ndarray, "M 3"]]:
    """Frames of objects in boxes, rotations about the camera's x and y that move them there [rad], their places [m].

    `T_camera_lidar` is from each frame's lidar points to its image.
    """
    days = enumerate(zip(observations, T_camera_lidar, strict=True))
    rows = [(k, *moved) for k, (o, T) in days for moved in _frame_offsets(o, T)]
    frame, offset, centre = zip(*rows, strict=True) if rows else ((), (), ())
    return np.array(frame, np.int64), np.array(offset).reshape(-1, 2), np.array(centre).reshape(-1, 3)


def _frame_offsets(o: Observation, T: Float[np.ndarray, "4 4"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    camera, boxes = camera_of(o), o.road_user_boxes_px.astype(np.float64)
    size = np.array([camera.width_px, camera.height_px] * 2)
    least = _LEAST_PX / o.label_scale
    whole = (boxes[:, :2] > _BORDER_PX).all(1) & (boxes[:, 2:] < size[2:] - _BORDER_PX).all(1)
    boxes = boxes[whole & (boxes[:, 2:] - boxes[:, :2] > least).all(1)]
    objects, centres = _objects(o, T)
    if not len(boxes) or not len(objects):
        return
    overlap = _overlap(boxes, objects)
    for b, row in enumerate(overlap):
        c = int(np.argmax(row))
        rivals = np.concatenate([np.delete(row, c), np.delete(overlap[:, c], b)])
        if row[c] > _LEAST_OVERLAP and (not len(rivals) or rivals.max() < row[c] / 2):
            apart = (boxes[b, :2] + boxes[b, 2:] - objects[c, :2] - objects[c, 2:]) / 2
            yield np.array([-apart[1] / camera.K[1, 1], apart[0] / camera.K[0, 0]]), centres[c]


def _objects(o: Observation, T: Float[np.ndarray, "4 4"]) -> tuple[_Boxes, Float[np.ndarray, "_ 3"]]:
    """Bounding box in the image of each lidar cluster, and its middle in camera axes [m]."""
    xyz = o.lidar_map_xyz_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    uv, is_seen = camera_of(o).project(xyz)
    found, centres = list[list[float]](), list[np.ndarray]()
    for c in range(len(o.lidar_cluster_centre_m)):
        of = o.lidar_map_cluster == c
        if of.sum() >= _FEWEST_POINTS and is_seen[of].all():
            found.append([*uv[of].min(0), *uv[of].max(0)])
            centres.append(xyz[of].mean(0))
    return np.array(found, np.float64).reshape(-1, 4), np.array(centres, np.float64).reshape(-1, 3)


def _overlap(a: _Boxes, b: _Boxes) -> Float[np.ndarray, "_ _"]:
    """Intersection over union of each with each."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    area = [np.prod(x[:, 2:] - x[:, :2], axis=1) for x in (a, b)]
    return np.asarray(shared / np.maximum(area[0][:, None] + area[1][None] - shared, 1e-9))
