"""fleet.toml for simulated logs."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.rig.topics import TOPICS, topics_of
from pipeline.simulate.sensors.data_sheets import CameraSpec, RadarSpec
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec

__all__ = ["fleet_toml", "mixed_fleet_toml"]


def fleet_toml(fleet: str, rig_name: str, rig: RigSpec, vehicles: list[str]) -> str:
    """Text of fleet.toml; the prior's sigmas are deviations of a pair of sensors from CAD."""
    return _text(fleet, {rig_name: rig}, dict.fromkeys(vehicles, rig_name))


def mixed_fleet_toml(fleet: str, rigs: Mapping[str, RigSpec]) -> str:
    """Text of fleet.toml for vehicles with a rig each."""
    return _text(fleet, {r.name: r for r in rigs.values()}, {v: r.name for v, r in rigs.items()})


def _text(fleet: str, rigs: Mapping[str, RigSpec], vehicles: Mapping[str, str]) -> str:
    lines = ["[fleet]", f'name = "{fleet}"', ""]
    for name, rig in rigs.items():
        lines += [*_sections(name, rig), ""]
    for vehicle, rig_name in vehicles.items():
        lines += [f'[vehicles."{vehicle}"]', f'rig = "{rig_name}"', ""]
    return "\n".join(lines[:-1]) + "\n"


def _sections(rig_name: str, rig: RigSpec) -> list[str]:
    lines = (
        []
        if rig.is_short
        else [f"[rigs.{rig_name}]", f'reference = "{rig.reference.name}"', 'base = "base_link"', ""]
    )
    for sensor in rig.sensors:
        lines += [f"[rigs.{rig_name}.{sensor.kind}{'' if rig.is_short else f's.{sensor.name}'}]"]
        lines += _sensor(sensor)
        lines.append("")
    return [
        *lines,
        f"[rigs.{rig_name}.ego]",
        f'odometry = "{TOPICS["odometry"]}"',
        "",
        f"[rigs.{rig_name}.prior]",
        'source = "tf_static"',
        "rotation_sigma_deg = 1.2",
        "translation_sigma_m = 0.03",
    ]


def _sensor(sensor: SensorSpec) -> list[str]:
    topics, sheet = topics_of(sensor.name, sensor.kind), sensor.sheet
    if isinstance(sheet, CameraSpec):
        return [
            f'image = "{topics["image"]}"',
            f'info = "{topics["info"]}"',
            (
                f'semantics = {{ source = "topics", labels = "{topics["labels"]}", '
                f'detections = "{topics["detections"]}", label_set = "cityscapes" }}'
            ),
            *([f"readout_s = {sheet.readout_s}"] if sheet.readout_s else []),
        ]
    points = [f'points = "{topics["points"]}"']
    if not isinstance(sheet, RadarSpec):
        return points
    period = sheet.doppler_period_mps
    return [
        *points,
        'doppler_field = "doppler"',
        f'doppler_positive = "{sheet.doppler_positive}"',
        *([f"doppler_period_mps = {period}"] if period is not None else []),
    ]
