"""Study: a segmenter that sees photographs, as the eye of a fleet without logged labels, as teacher, and as encoder.

    python -m tests.benchmarks.studies.ssl_teacher --logged REAL --teacher TEACHER... --segmenter segmenter.toml \
        --encoders shipped=joint_classes.onnx taught=TUNED.onnx --judge LOG

REAL and TEACHER are folders with fleet.toml and lake of the same real vehicle-day, perceived by its logged labels, and
by the segmenter (`semantics = { source = "onnx", ... }`), log by log where that suits. Told are how far the two
labellings agree, and what encoders of images alone make of the frames of one log: shares of the grid's cells with the
logged class, and how often ground and what stands on it, as the lidar tells them by geometry, fall on cells of such
classes at the logged calibration. The lidar owes nothing to the segmenter, which made the logged labels too. `probe` is
a linear classifier on features inside the segmenter, fitted to logged classes on the other logs: what an encoder begins
with that is pretrained.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import onnx.utils
import onnxruntime
from jaxtyping import Float, Float32, Int

from pipeline.geometry.cameras import camera_of
from pipeline.geometry.se3 import transform_points
from pipeline.geometry.spherical import camera_direction_angles
from pipeline.learn.infer.onnx_networks import open_networks
from pipeline.learn.infer.single_frame import SingleFrameCalibrator
from pipeline.learn.sample.camera_maps import class_likelihood
from pipeline.learn.sample.grid import Grid, grid_rays
from pipeline.learn.sample.layout import LIKELIHOOD
from pipeline.objective.paper.classes import labels_of
from pipeline.perceive.models.manifest import Manifest, load_manifest
from pipeline.perceive.models.session import fit_image
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import CLASS_OF_LABEL, GRID_CLASSES, UNKNOWN_CLASS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay
from tests.benchmarks.studies.ssl_photographs import by_log, real_day

__all__ = ["agreement", "cells_of", "judged_by_lidar", "linear_probe", "summary"]

GROUND = [GRID_CLASSES.index(name) for name in ("road", "verge")]
SKY = GRID_CLASSES.index("sky")
# ESPNetv2's encoder at an eighth of the image: cells of half a degree on that car, about the grid's own.
FEATURES = "/level3.2/Concat_output_0"
_RIDGE = 1e-3  # of the mean square of a feature: keeps the fit solvable, and nothing more
_NEAR_M, _FAR_M = 4.0, 50.0  # of the lidar's points: nearer the car itself, farther 16 rings say little


def cells_of(observation: Observation, grid: Grid) -> Int[np.ndarray, "H W"]:
    """The class of each cell by the frame's labels; UNKNOWN_CLASS where most of it has none."""
    told = class_likelihood(labels_of(observation), camera_of(observation), grid)
    return np.where(told[-1] > 0, told[:-1].argmax(0), UNKNOWN_CLASS)


def agreement(
    pairs: Iterable[tuple[Int[np.ndarray, "H W"], Int[np.ndarray, "H W"]]],
) -> dict[str, Any]:
    """Of cells (or pixels) that both know: the share that is equal, and each class's overlap (IoU) and their mean."""
    count = np.zeros((len(GRID_CLASSES), len(GRID_CLASSES)))
    for a, b in pairs:
        both = (a != UNKNOWN_CLASS) & (b != UNKNOWN_CLASS)
        np.add.at(count, (a[both], b[both]), 1)
    hit = np.diag(count)
    union = count.sum(0) + count.sum(1) - hit
    iou = {name: float(h / u) for name, h, u in zip(GRID_CLASSES, hit, union, strict=True) if u > 0}
    told = {"equal": float(hit.sum() / count.sum()), "mean_iou": float(np.mean(list(iou.values())))}
    return {k: round(v, 3) for k, v in (told | iou).items()}


def judged_by_lidar(
    classes: Int[np.ndarray, "H W"], row: Observation, T_camera_lidar: Float[np.ndarray, "4 4"], grid: Grid
) -> Int[np.ndarray, "2 2"]:
    """Points by what geometry says (ground, standing), and by what the cell says that they fall into.

    Points between 4 and 50 m, on the fitted ground or in a cluster; sky counts as standing. Cells nobody knows are left
    out.
    """
    ground, cluster = row.lidar_map_is_ground > 0, row.lidar_map_cluster >= 0
    distance = np.linalg.norm(row.lidar_map_xyz_m, axis=1)
    kept = (ground | cluster) & (distance > _NEAR_M) & (distance < _FAR_M)
    points = transform_points(T_camera_lidar, row.lidar_map_xyz_m[kept].astype(np.float64))
    azimuth, elevation = camera_direction_angles(points).T
    column = np.floor((grid.left_deg - np.degrees(azimuth)) / grid.cell_deg).astype(int)
    line = np.floor((grid.top_deg - np.degrees(elevation)) / grid.cell_deg).astype(int)
    inside = (line >= 0) & (line < grid.height) & (column >= 0) & (column < grid.width) & (points[:, 2] > 0)
    said = classes[line[inside], column[inside]]
    known = said != UNKNOWN_CLASS
    found = np.zeros((2, 2), int)
    np.add.at(
        found, ((~ground[kept][inside][known]).astype(int), (~np.isin(said[known], GROUND)).astype(int)), 1
    )
    return found


def linear_probe(
    features: Sequence[Float32[np.ndarray, "C H W"]], classes: Sequence[Int[np.ndarray, "H W"]]
) -> Float[np.ndarray, "D K"]:
    """Ridge regression of classes, one-hot and weighed alike, on features and a constant (last row)."""
    size = len(features[0]) + 1
    H, g = np.zeros((size, size)), np.zeros((size, len(GRID_CLASSES)))
    for maps, known in zip(features, classes, strict=True):
        mask = known != UNKNOWN_CLASS
        x = np.column_stack([maps[:, mask].T.astype(np.float64), np.ones(mask.sum())])
        H += x.T @ x
        np.add.at(g.T, known[mask], x)
    return np.linalg.solve(H + _RIDGE * np.diag(H).mean() * np.eye(size), g)


def probed(weights: Float[np.ndarray, "D K"], maps: Float32[np.ndarray, "C H W"]) -> Int[np.ndarray, "H W"]:
    """Classes of every cell by a linear probe."""
    scores = np.einsum("chw,ck->khw", maps, weights[:-1]) + weights[-1][:, None, None]
    return scores.argmax(0)


class Features:
    """Maps from inside a segmenter, at the cells of a grid."""

    def __init__(self, manifest: Manifest, output: str) -> None:
        model = onnx.shape_inference.infer_shapes(onnx.load(str(manifest.model_file)))
        cut = onnx.utils.Extractor(model).extract_model([model.graph.input[0].name], [output])
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            cut.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self._input, self._manifest = model.graph.input[0].name, manifest

    def of(self, frame: Frame, row: Observation, grid: Grid) -> Float32[np.ndarray, "C H W"]:
        """Bilinear at the centres of cells; of an input that the image was stretched to."""
        image = cv2.imdecode(np.frombuffer(frame.image, np.uint8), cv2.IMREAD_COLOR)
        tensor, _ = fit_image(image, self._manifest.input)
        [maps] = self._session.run(None, {self._input: tensor})
        camera = camera_of(row)
        uv, _ = camera.project(grid_rays(grid))
        scale = np.array([maps.shape[3] / camera.width_px, maps.shape[2] / camera.height_px])
        at = ((uv + 0.5) * scale - 0.5).astype(np.float32)
        planes = [
            cv2.remap(p, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for p in maps[0]
        ]
        return np.stack(planes)


def encoder_of(path: Path) -> Callable[[np.ndarray], Float32[np.ndarray, "K H W"]]:
    """A network's encoder: logits of the classes from its input `camera`, one frame."""
    model = onnx.load(str(path))
    makers = {name: node for node in model.graph.node for name in node.output}
    # Backwards from what the matchers are given to the only normalisation on the way, each name once.
    ahead = [LIKELIHOOD]
    for name in ahead:
        node = makers.get(name)
        if node is not None and node.op_type in {"LogSoftmax", "Softmax"}:
            break
        ahead += [n for n in (node.input if node is not None else ()) if n not in ahead]
    logits = node.input[0]
    cut = onnx.utils.Extractor(onnx.shape_inference.infer_shapes(model)).extract_model(["camera"], [logits])
    session = onnxruntime.InferenceSession(cut.SerializeToString(), providers=["CPUExecutionProvider"])

    def encode(camera: np.ndarray) -> Float32[np.ndarray, "K H W"]:
        [found] = session.run([logits], {"camera": camera.astype(np.float32)})[0]
        return found if len(found) == len(GRID_CLASSES) else found.transpose(2, 0, 1)  # exporters differ

    return encode


def seen_by(models: ModelSet, day: SslDay, frames: Sequence[tuple[Frame, Observation]]) -> list[np.ndarray]:
    """Classes of the cells by a network's encoder, from images alone."""
    fleet = models.configured(day.fleet).changed(learn={"camera": "image"})
    [network] = open_networks(models.by_name, fleet.learn, fleet.prepare)
    encode = encoder_of(models.files[0])
    channels, prior = SingleFrameCalibrator(models.files[0]).config.camera_channels, day.prior(0.0, 0.0, 0)
    out = []
    for frame, row in frames:
        camera = network.sensors(frame, row, prior).camera_channels(channels)
        out.append(encode(camera).argmax(0))
    return out


def measured(
    answers: Iterable[np.ndarray],
    logged: Sequence[np.ndarray],
    rows: Sequence[Observation],
    T: np.ndarray,
    grid: Grid,
) -> dict[str, Any]:
    """An encoder's row: against the logged classes, and against the lidar."""
    answers = [np.where(b == UNKNOWN_CLASS, UNKNOWN_CLASS, a) for a, b in zip(answers, logged, strict=True)]
    found = sum(judged_by_lidar(a, row, T, grid) for a, row in zip(answers, rows, strict=True))
    right = np.diag(found) / found.sum(1)
    lidar = {"ground": float(right[0]), "standing": float(right[1]), "mean": float(right.mean())}
    told = agreement(zip(answers, logged, strict=True))
    return {k: told[k] for k in ("equal", "mean_iou")} | {f"lidar_{k}": round(v, 3) for k, v in lidar.items()}


def paired(day: SslDay, rows: Sequence[Observation]) -> Iterator[tuple[Frame, Observation]]:
    """Frames of rows, read together."""
    some, frames = SslDay(day.where, list(rows), day.truth, day.fleet).spread(len(rows))
    yield from zip(frames, some, strict=True)


def summary(told: dict[str, Any]) -> str:
    """Markdown: agreement of the labellings, and a row for every encoder."""
    lines = [
        f"commit {told['commit']}; {told['date']}",
        "",
        f"The segmenter's labels against those logged, {told['frames']} frames: share that is equal, mean overlap:",
        "",
        "| of | equal | mean IoU |",
        "|---|---|---|",
        *(f"| {what} | {a['equal']:.3f} | {a['mean_iou']:.3f} |" for what, a in told["agreement"].items()),
        "",
        f"Classes of cells, {told['judged']} frames of {told['judge']}, by images alone but for the first two rows:",
        "",
        "| by | logged class | mean IoU with logged | lidar: ground | standing | mean |",
        "|---" * 6 + "|",
    ]
    keys = ("equal", "mean_iou", "lidar_ground", "lidar_standing", "lidar_mean")
    lines += [f"| {by} | {' | '.join(f'{r[k]:.3f}' for k in keys)} |" for by, r in told["encoders"].items()]
    return "\n".join(lines)


def main() -> None:
    """Measure, write, print."""
    args = _arguments()
    logged, teachers = real_day(args.logged), [real_day(folder) for folder in args.teacher]
    grid = SingleFrameCalibrator(args.encoders[0].files[0]).grid
    given = {o.camera_stamp_ns: o for o in logged.rows}
    both = [(o, given[o.camera_stamp_ns]) for day in teachers for o in day.rows if o.camera_stamp_ns in given]
    pixels = ((_pixels(a, b), CLASS_OF_LABEL[labels_of(b)]) for a, b in both)
    cells = {o.frame_index: cells_of(o, grid) for o in logged.rows}
    taught = {o.frame_index: cells_of(by, grid) for by, o in both}
    agreed = {"pixels": agreement(pixels), "cells": agreement((taught[k], cells[k]) for k in taught)}
    # The judge's frames, and all others, which the probe learns from.
    judge = by_log(logged)[args.judge].rows
    names = {o.frame_index for o in judge}
    frames, truth = list(paired(logged, judge)), [cells[o.frame_index] for o in judge]
    T = logged.true_of("camera_lidar")
    rows: dict[str, Sequence[np.ndarray]] = {"logged labels": truth}
    rows["the segmenter's labels"] = [taught[o.frame_index] for o in judge]
    features = Features(load_manifest(args.segmenter, "segment"), FEATURES)
    others = list(paired(logged, [o for o in logged.rows if o.frame_index not in names]))
    weights = linear_probe(
        [features.of(f, o, grid) for f, o in others], [cells[o.frame_index] for _, o in others]
    )
    rows["linear probe of the segmenter's encoder"] = [
        probed(weights, features.of(f, o, grid)) for f, o in frames
    ]
    rows |= {m.name: seen_by(m, logged, frames) for m in args.encoders}
    told = {
        "commit": commit_now(), "date": time.strftime("%Y-%m-%d"), "frames": len(both), "agreement": agreed,
        "judge": args.judge, "judged": len(judge),
        "encoders": {by: measured(found, truth, judge, T, grid) for by, found in rows.items()},
    }  # fmt: skip
    args.out.write_text(json.dumps(told, indent=1) + "\n")
    args.out.with_suffix(".md").write_text(summary(told) + "\n")
    print(summary(told))


def _pixels(teacher: Observation, logged: Observation) -> Int[np.ndarray, "H W"]:
    """The teacher's classes at the size of the logged labels."""
    size = labels_of(logged).shape
    labels = cv2.resize(labels_of(teacher), (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return CLASS_OF_LABEL[labels]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logged", type=Path, required=True)
    parser.add_argument("--teacher", type=Path, nargs="+", required=True)
    parser.add_argument("--segmenter", type=Path, required=True, help="its manifest")
    parser.add_argument("--encoders", nargs="+", type=ModelSet.parse, required=True, metavar="NAME=FILE")
    parser.add_argument("--judge", required=True, help="the log that nobody learned from")
    parser.add_argument("--out", type=Path, default=RESULTS / "ssl_teacher.json")
    return parser.parse_args()


if __name__ == "__main__":
    main()
