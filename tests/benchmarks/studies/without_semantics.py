"""Study: camera-lidar of cameras without semantics, by steps of brightness in the picture in the place of labels.

    python -m tests.benchmarks.studies.without_semantics --root FOLDER

Logs are read without their labels and road users. A border is where brightness steps most, along its axis, in runs of
eight pixels at least; which side is nearer no step tells, so each is a border of both. Paint is looked for on the
ground that the lidar finds free, as the start projects it, widened by what the start may be off. Terms, solver and
verdict are those of `joint`. Starts are exactly 2 deg / 5 cm off, as they state; `z` is the error in sigmas of both.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from unittest import mock

import cv2
import numpy as np
from jaxtyping import Bool, Int8, UInt8

from pipeline.calibrate.day import calibrate_observations
from pipeline.calibrate.records import Inputs
from pipeline.config import FleetConfig, load_fleet
from pipeline.extrinsics.estimates import Prior
from pipeline.extrinsics.prior import perturbed, read_prior
from pipeline.geometry.cameras import Camera, camera_of
from pipeline.geometry.targets import errors_at_targets
from pipeline.objective.camera_lidar import score
from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY, REACH_PX, CameraMaps, contrast_levels
from pipeline.perceive import stage
from pipeline.perceive.camera import CameraSemantics, Detections, decode_grey
from pipeline.perceive.road_markings import road_contrast
from pipeline.sections import TERMS
from pipeline.store.current import targets_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.calibrations import CalibrationRecord
from schemas.captures import ImageColumns
from schemas.observations import Observation
from tests.accuracy.days import SHARED
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.engine import RESULTS
from tests.benchmarks.studies.metrics import rms, share, transform_of
from tests.makers.stages import ingest_day, perceive_day

__all__ = ["brightness_steps", "offsets_to", "summary"]

_PAIR: Final = "camera_lidar"
_START: Final = (2.0, 0.05)
_BLUR_PX, _STRONGEST, _RUN_PX = 1.0, 0.07, 8  # of steps: blur, share of pixels, shortest run
_TERMS: Final = {"edges": tuple(t for t in TERMS if t != "reflectivity"), "edges and paint": TERMS}
_CAMERA_AND_LIDAR: Final = """
[rigs.default.camera]
image = "/camera/front/image/compressed"
info = "/camera/front/camera_info"
[rigs.default.lidar]
points = "/lidar/top/points"
[rigs.default.prior]
source = "tf_static"
"""
_RADAR: Final = """
[rigs.default.radar]
points = "/radar/front/points"
doppler_field = "doppler"
"""
_ASTYX: Final = 'doppler_positive = "approaching"\ndoppler_period_mps = 10.394\n'
_OTHER: Final = 'doppler_positive = "receding"\n[rigs.default.ego]\nodometry = "/vehicle/odometry"\n'
# By log: files, vehicle-day, fleet.toml beyond camera and lidar, and how well the reference is known [deg].
_LOGS: Final = {
    "other_world": ("other_world/*.mcap", Partition("veh00", "2026-03-02"), _RADAR + _OTHER, 0.0),
    "real car": ("astyx/astyx-1_*", Partition("astyx-1", "2019-01-14"), _RADAR + _ASTYX, 0.2),
    "kitti": ("kitti/*.mcap", Partition("kitti-1", "2011-09-26"), "", 0.1),
}


def main() -> None:
    """Write a line per start and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="lakes are made here, or used if there")
    parser.add_argument("--data", type=Path, default=SHARED, help="folder of the recordings")
    parser.add_argument("--logs", nargs="+", choices=_LOGS, default=list(_LOGS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)))
    parser.add_argument("--out", type=Path, default=RESULTS / "without_semantics.jsonl")
    args = parser.parse_args()
    about, lines = {"commit": commit_now(), "date": time.strftime("%Y-%m-%d")}, []
    for log in args.logs:
        rows, fleet, true = _day(log, args.data, args.root)
        for terms in _TERMS:
            for seed in args.seeds:
                line = {"log": log, "terms": terms, "start_deg": _START[0], "seed": seed}
                lines.append(about | line | _calibrated(log, rows, fleet, true, terms, seed))
                print(json.dumps(lines[-1]), flush=True)
    args.out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    print(summary(lines))


class _Brightness:
    """Pictures in the place of their labels, no road users: a source of semantics for a camera without any."""

    def __init__(self, label_scale: float) -> None:
        self._scale = label_scale

    def read(self, frame: ImageColumns) -> CameraSemantics:
        """The grey picture at label size."""
        nobody = Detections(np.empty((0, 4), np.float32), [], np.empty(0, np.float32))
        return CameraSemantics(decode_grey(frame, self._scale), nobody)


def _day(log: str, data: Path, root: Path) -> tuple[list[Observation], FleetConfig, Prior]:
    """A day without its labels, and the reference: the truth where there is one, else as logged."""
    files, day, extra, _ = _LOGS[log]
    folder = root / log.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    toml, lake = folder / "fleet.toml", Lake.at(folder / "lake")
    vehicle = f'[fleet]\nname = "without-semantics"\n[vehicles."{day.vehicle}"]\nrig = "default"\n'
    toml.write_text(vehicle + _CAMERA_AND_LIDAR + extra)
    fleet, sources_of = load_fleet(toml), stage._sources

    def with_pictures(rig: Any, config: FleetConfig) -> tuple[stage.Sources, dict[str, Any]]:
        sources, keys = sources_of(rig, config)
        picture = _Brightness(config.perceive.label_scale)
        return replace(sources, cameras=dict.fromkeys(rig.cameras, picture)), keys

    if day not in lake.partitions("perceived"):
        ingest_day(sorted(data.glob(files)), day, fleet, lake)
        with mock.patch.object(stage, "_sources", with_pictures):
            perceive_day(day, fleet, lake)
    rows = [replace(row, label_gradients=None) for row in observations_of(lake, day)]
    given, truth = read_prior(rows, fleet, day.vehicle), (data / files).parent / "truth.json"
    if truth.exists():
        known = {k: np.array(T) for k, T in json.loads(truth.read_text()).items() if k.startswith("T_")}
        given = replace(given, T_camera_lidar=known["T_camera_lidar"], T_lidar_radar=known["T_lidar_radar"])
    return rows, fleet, given


def _calibrated(
    log: str, rows: Sequence[Observation], fleet: FleetConfig, true: Prior, terms: str, seed: int
) -> dict[str, Any]:
    """What a start led to."""
    prior, began = perturbed(true, _START, seed), time.process_time()
    inputs = Inputs(_LOGS[log][1], "joint", "study", seed, (), pairs=(_PAIR,))
    asked = fleet.changed(solve={"terms": _TERMS[terms]})
    with mock.patch.object(score, "prepare_maps", _maps_about(prior)):
        [record] = calibrate_observations(rows, prior, asked, inputs)
    cost = {"cpu_s": round(time.process_time() - began, 1)}
    return cost | _line_of(record, true, _LOGS[log][3])


def _line_of(record: CalibrationRecord, true: Prior, known_deg: float) -> dict[str, Any]:
    told = {"status": record.status, "reason": record.reason, "frames_used": record.frames_used}
    T = transform_of(record)
    if T is None or record.azimuth_sigma_rad is None or record.elevation_sigma_rad is None:
        return told
    off = np.degrees(errors_at_targets(_PAIR, T, true.of(_PAIR), targets_of(record))[:2])
    sigma = np.degrees([record.azimuth_sigma_rad, record.elevation_sigma_rad])
    names = ("az_deg", "el_deg", "az_sigma_deg", "el_sigma_deg", "az_z", "el_z")
    values = [*off, *sigma, *(off / np.hypot(sigma, known_deg))]
    return told | {name: round(float(v), 3) for name, v in zip(names, values, strict=True)}


def _maps_about(start: Prior) -> Callable[[Sequence[Observation], tuple[float, ...]], CameraMaps]:
    """What takes the place of `image_maps.prepare_maps`: maps of pictures, about a start."""

    def prepared(observations: Sequence[Observation], blurs_px: tuple[float, ...]) -> CameraMaps:
        camera = camera_of(observations[0]).scaled(observations[0].label_scale)
        grey = np.stack([_decoded(o.labels_png) for o in observations])
        count, size = len(grey), grey.shape[1:]
        offsets = np.empty((count, 4, *size), np.int8)
        contrast = np.zeros((len(blurs_px), count, *size), np.int8)
        for f, o in enumerate(observations):
            offsets[f, :2] = offsets_to(brightness_steps(grey[f]))
            offsets[f, 2:] = offsets_to(brightness_steps(grey[f].T)).T
            is_road = _ground_in(o, camera, start)
            contrast[:, f] = contrast_levels(road_contrast(grey[f], is_road), is_road, blurs_px)
        # The basin's mutual information then is that of height and brightness.
        return CameraMaps(camera, offsets, contrast, grey >> 4)

    return prepared


def _decoded(png: bytes) -> UInt8[np.ndarray, "H W"]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


def brightness_steps(grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Whether brightness steps between a pixel and the next one of its row: a maximum along the row, in a long run."""
    blurred = cv2.GaussianBlur(np.ascontiguousarray(grey, np.float32), (0, 0), _BLUR_PX)
    along, down = np.zeros_like(blurred), np.zeros_like(blurred)
    along[:, :-1] = np.abs(np.diff(blurred, axis=1))
    down[:-1] = np.abs(np.diff(blurred, axis=0))
    is_step = along > max(float(np.quantile(along, 1 - _STRONGEST)), 0.5)
    is_step[:, 1:-1] &= (along[:, 1:-1] >= along[:, :-2]) & (along[:, 1:-1] > along[:, 2:])
    is_step[:, [0, -1]] = False
    is_step &= along > 0.7 * down
    _, run, stats, _ = cv2.connectedComponentsWithStats(is_step.astype(np.uint8), connectivity=8)
    is_long = stats[:, cv2.CC_STAT_HEIGHT] >= _RUN_PX
    is_long[0] = False
    return is_long[run]


def offsets_to(is_step: Bool[np.ndarray, "H W"]) -> Int8[np.ndarray, "H W"]:
    """k of k + 1/2 px to each pixel's nearest step along its row, as `image_maps.boundary_offsets` of labels."""
    column, far = np.arange(is_step.shape[1]), 10_000
    behind = np.maximum.accumulate(np.where(is_step, column, -far), axis=1)
    behind = np.pad(behind, ((0, 0), (1, 0)), constant_values=-far)[:, :-1] - column
    ahead = np.minimum.accumulate(np.where(is_step, column, far)[:, ::-1], axis=1)[:, ::-1] - column
    nearest = np.where(2 * ahead + 1 < -2 * behind - 1, ahead, behind)
    return np.where(np.abs(nearest) <= REACH_PX, nearest, NO_BOUNDARY).astype(np.int8)


def _ground_in(o: Observation, camera: Camera, start: Prior) -> Bool[np.ndarray, "H W"]:
    """Pixels that may show the ground that the lidar finds free: as a start projects it, give or take its sigma."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    T, ends = start.T_camera_lidar, o.lidar_drivable_xyz_m.astype(np.float64)
    uv, is_seen = camera.project(ends @ T[:3, :3].T + T[:3, 3])
    if np.count_nonzero(is_seen) < 3:
        return mask > 0
    top = uv[is_seen][np.argsort(uv[is_seen, 0])]
    foot = [[top[-1, 0], camera.height_px], [top[0, 0], camera.height_px]]
    cv2.fillPoly(mask, [np.round(np.concatenate([top, foot])).astype(np.int32)], 1)
    reach_px = round(float(camera.K[0, 0]) * start.rotation_sigma_rad)
    return cv2.dilate(mask, np.ones((2 * reach_px + 1,) * 2, np.uint8)) > 0


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """A row per log and terms."""
    head = "| log | terms | azimuth, mean, worst [deg] | elevation | mean sigmas | RMS z | accepted | CPU s |"
    text = [head, "|---" * 8 + "|"]
    for log, terms in dict.fromkeys((r["log"], r["terms"]) for r in lines):
        mine = [r for r in lines if (r["log"], r["terms"]) == (log, terms)]
        known = [r for r in mine if "el_z" in r]
        off = [
            f"{np.mean([r[k] for r in known]):.2f}, {max(r[k] for r in known):.2f}" if known else "-"
            for k in ("az_deg", "el_deg")
        ]
        sigma = "/".join(f"{np.mean([r[k] for r in known]):.2f}" for k in ("az_sigma_deg", "el_sigma_deg"))
        z = rms([r[k] for r in known for k in ("az_z", "el_z")])
        accepted = share(r["status"] == "accepted" for r in mine)
        cpu = np.mean([r["cpu_s"] for r in mine])
        text.append(f"| {log} | {terms} | {' | '.join(off)} | {sigma} | {z:.1f} | {accepted} | {cpu:.0f} |")
    return "\n".join(text)


if __name__ == "__main__":
    main()
