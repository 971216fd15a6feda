"""The card of an export: frames kept and left out with reasons, calibration and its sigmas, how to open it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.learn.frames.nuscenes import finish_nuscenes
from pipeline.learn.frames.output import Output
from pipeline.store.partitions import Partition
from schemas.training import SPLITS
from schemas.versions import CODE_VERSION

__all__ = ["write_card"]

_CONVENTIONS = (
    "T_a_b takes coordinates in frame b to frame a, row-major 4x4, metres. Cameras: x right, y down, z forward; "
    "lidars, radars and the car: x forward, y left, z up. Sigmas: rotation about the reference's axes, and place of "
    "the sensor. range_rate is positive where a target recedes, and holds the car's own motion."
)
_SYNCHRONISED = (
    "The sensors of a frame measured nearly at the same time (within the limit of [ingest]), and each has its own "
    "stamp. Each sweep states whether it is de-skewed to its stamp."
)
_OPEN = {
    "parquet": (
        '`from dataset import Frames; DataLoader(Frames(".", "train"), num_workers=2, collate_fn=list)`: dataset.py '
        "lies here and needs torch and pyarrow. A row is a frame. Images are as logged, not undistorted; points are "
        "NaN where the log has no value."
    ),
    "nuscenes": (
        'NuScenes("v1.0-boresight", "."); splits by scene are in v1.0-boresight/splits.json. Images are undistorted '
        "with the logged K. object_ann.json (nuImages' table) has boxes in the image, labels/CHANNEL/*.png labels; "
        "there are no boxes in space and no map (a grey pixel replaces it). If the reference's pose on the car is "
        "unknown, the ego frame is the reference. Rings and intensities that are not logged are 0."
    ),
}


def write_card(
    output: Output, settings: Mapping[str, Any], days: Sequence[Partition],
    left_out: Sequence[Mapping[str, str]],
) -> dict[str, Any]:  # fmt: skip
    """Write card.json and README.md of an export from its finished days; returns the card."""
    done = [told for day in days if (told := output.done(day)) is not None]
    frames, lost, sensors = Counter[str](), Counter[str](), Counter[str]()
    for told in done:
        frames.update(told["frames"])
        lost.update(told["left_out"])
        sensors.update(told["sensors"])
    files: dict[str, list[str]] = {split: [] for split in SPLITS}
    for part, row in (found for day in days for found in output.rows(day)):
        if part in files:
            files[part].append(row)
    card = {
        "made_by": f"Boresight {CODE_VERSION}", "settings": dict(settings), "files": files,
        "frames": {split: frames[split] for split in SPLITS}, "frames_of_sensors": dict(sensors),
        "frames_left_out": dict(lost), "vehicle_days_left_out": list(left_out), "conventions": _CONVENTIONS,
        "vehicle_days": [{n: t[n] for n in ("vehicle", "day", "frames", "left_out", "calibration")} for t in done],
        "labels": "Cityscapes train ids (0 road .. 18 bicycle, 255 void), as perceive read or made them",
    }  # fmt: skip
    if settings["format"] == "nuscenes":
        finish_nuscenes(output, days)
    if settings["format"] == "parquet":
        output.write("dataset.py", Path(__file__).with_name("torch_dataset.py").read_bytes())
    output.write("README.md", _page(card, settings).encode())
    output.write("card.json", (json.dumps(card, indent=1, sort_keys=True) + "\n").encode())
    return card


def _page(card: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    days = card["vehicle_days"]
    lost = [f"- {n} frames: {r.replace('_', ' ')}" for r, n in sorted(card["frames_left_out"].items())]
    moved = settings["perturb"]
    lines = [
        "# Frames with their calibration",
        f"Vehicles: {len({d['vehicle'] for d in days})}, vehicle-days: {len(days)}.",
        f"Made by {card['made_by']}; all of this page is in card.json too.\n",
        "| split | frames |\n|---|---|\n" + "\n".join(f"| {s} | {n} |" for s, n in card["frames"].items()),
        f"\nNo two splits share a {' or a '.join(settings['split']['split_by'])}. {_SYNCHRONISED}",
        "\n## Left out\n" + ("\n".join(lost) or "No frame."),
        *(f"- {d['vehicle']} {d['day']}: {d['reason']}" for d in card["vehicle_days_left_out"]),
        *_without_pose(days),
        f"\n## Calibration: {settings['calibration']}\n{card['conventions']}",
        "\n| sensor | largest sigma of rotation [deg] | of place [m] |\n|---|---|---|\n"
        + "\n".join(_worst(days)),
    ]
    if moved is not None:
        lines.append(
            f"\nPoses are moved on purpose by exactly {moved[0]:g} deg and {moved[1]:g} m, one draw per "
            f"{settings['perturb_per']} from seed {settings['seed']}; `answer_T_reference_sensor` ("
            "calibrated_sensor_answer.json) is where each sensor was."
        )
    lines += [f"\n## Open it\n{_OPEN[settings['format']]}", f"\nLabels: {card['labels']}.\n"]
    return "\n".join(lines)


def _without_pose(days: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each reason why poses are missing, with its vehicle-days."""
    of: dict[str, list[str]] = {}
    for day in days:
        for name, reason in day["calibration"]["left_out"].items():
            of.setdefault(f"pose of {name}: {reason}", []).append(f"{day['vehicle']} {day['day']}")
    return [f"- {words} ({len(on)} vehicle-days, the first {on[0]})" for words, on in sorted(of.items())]


def _worst(days: Sequence[Mapping[str, Any]]) -> list[str]:
    """Table rows of the largest sigmas of each sensor."""
    of: dict[str, list[tuple[float, float] | None]] = {}
    for day in days:
        for name, pose in day["calibration"]["sensors"].items():
            if name != day["calibration"]["reference"]:
                turn, shift = pose.get("sigma_rotation_deg"), pose.get("sigma_translation_m")
                of.setdefault(name, []).append((max(turn), max(shift)) if turn and shift else None)
    rows = []
    for name, found in sorted(of.items()):
        known = [sigma for sigma in found if sigma is not None]
        worst = [f"{max(s[k] for s in known):.3f}" if known else "not known" for k in (0, 1)]
        rows.append(f"| {name} | {worst[0]} | {worst[1]} |")
    return rows
