"""The rig from above: what is forward is up, what looks left looks left, and nothing of the rig is left out."""

import re

import numpy as np

from pipeline.report.rig_figure import DrawnSensor, rig_figure
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from tests.makers.table_rows import make_record

OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of a camera that looks forward


def sensor(name, kind, yaw_deg, x, y, width_deg=90.0, status="accepted"):
    R = exp_so3(np.array([0, 0, np.radians(yaw_deg)])) @ (OPTICAL if kind == "camera" else np.eye(3))
    T = from_rotation_translation(R, np.array([x, y, 1.5]))
    return DrawnSensor(name, kind, T, np.radians(width_deg), status, "azimuth ±0.03°")


def centre(drawing, name):
    [found] = re.findall(rf'<circle cx="([\d.]+)" cy="([\d.]+)" r="5"[^>]*><title>{name}:', str(drawing))
    return tuple(float(v) for v in found)


def test_forward_is_up_and_left_is_left():
    front, left = sensor("front", "camera", 0, 2, 0), sensor("left", "camera", 90, 0, 1)
    drawing = rig_figure([front, left, sensor("top", "lidar", 0, 0, 0)], [])
    assert centre(drawing, "front")[1] < centre(drawing, "top")[1]
    assert centre(drawing, "left")[0] < centre(drawing, "top")[0]


def test_a_view_to_the_left_is_drawn_to_the_left():
    drawing = rig_figure([sensor("left", "camera", 90, 0, 0), sensor("top", "lidar", 0, 0, 0, 360)], [])
    u, v = centre(drawing, "left")
    [(x0, y0, x1, y1)] = re.findall(
        rf'd="M{u:.1f} {v:.1f}L([\d.]+) ([\d.]+)A74 74 0 0 0 ([\d.]+) ([\d.]+)Z', str(drawing)
    )
    assert max(float(x0), float(x1)) < u
    assert float(y0) < v < float(y1) or float(y1) < v < float(y0)


def test_every_sensor_and_edge_is_there_and_names_cannot_break_the_page():
    sensors = [sensor(f"s<{k}>", "radar", 30 * k, np.cos(k), np.sin(k), status="none") for k in range(30)]
    about = {"parent_frame": "s<0>", "status": "held"}
    edges = [make_record(np.random.default_rng(0), "k", child_frame=b, **about) for b in ("s<1>", "gone")]
    drawing = str(rig_figure(sensors, edges))
    assert "s<0>" not in drawing
    assert all(drawing.count(f"s&lt;{k}&gt;</t") + drawing.count(f"s&lt;{k}&gt;<ts") for k in range(30))
    assert 'y="-' not in drawing  # the drawing grows with its columns of names
    assert drawing.count("stroke-dasharray") == 1  # an edge to a sensor that the rig lacks is not drawn
