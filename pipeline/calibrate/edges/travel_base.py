"""A vehicle frame for a rig that has none: the car's own travel, in which its sensors are compared.

Each sensor sees the direction of travel, and lidars the road, in axes of its own. So edges to a frame on which nothing
is mounted are solved as in rigs with one, and the adjustment is free to put it anywhere: what remains is how sensors
stand to each other by motion, a camera without labels. The car's stance is common to all of them and cancels. The frame
is no sensor of the rig: it has no record and no pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.camera_base import FEWEST
from pipeline.calibrate.edges.sweep_travel import Sweep, sweeps_of
from pipeline.objective.ego_motion import mean_heading, shown_heading
from pipeline.rig.graph import BASE, RigGraph, edge_between
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import from_rotation_translation
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = ["with_travel"]

_NEAR_M, _FEWEST_POINTS = 15.0, 60  # of a sweep's ground that shows where the road is
_BEHIND_M = 1.5  # the rear axle, behind lidars on the roof (1 m) and at the nose (4 m)
# Of the frame before the day [rad, m]: so loose that only edges place it.
_SIGMAS = (float(np.radians(20.0)), 3.0)


def with_travel(
    graph: RigGraph, prior: RigPrior, rows: Callable[[Chosen], list[Observation]]
) -> tuple[RigGraph, RigPrior]:
    """Graph and prior with the frame, and an edge of each sensor to it.

    The same ones where the rig has a frame, no camera shows how it moves, or no lidar shows the road.
    """
    reference, lidar = prior.reference.name, next((s.name for s in graph.of_kind("lidar")), "")
    T = prior.between(reference, lidar)
    if BASE in graph.sensors or T is None:
        return graph, prior
    seen = (rows({"camera": camera.name}) for camera in graph.of_kind("camera"))
    if all(sum(o.motion_turn_rad is not None for o in of_camera) < FEWEST for of_camera in seen):
        return graph, prior
    headings = list[tuple[float, float]]()
    for radar in (r.name for r in graph.of_kind("radar")):
        mounted = prior.between(lidar, radar)
        way = None if mounted is None else shown_heading(rows({"lidar": lidar, "radar": radar}), mounted)
        headings += [] if way is None else [(way, prior.sigmas_between(lidar, radar)[0])]
    T_lidar_base = _on_road(sweeps_of(rows({"lidar": lidar})), (mean_heading(headings) or (0.0, 0.0))[0])
    if T_lidar_base is None:
        return graph, prior
    edges = (*graph.edges, *(edge_between(s, BASE) for s in graph.sensors if s not in prior.untied))
    known = {**prior.T, (reference, BASE.name): T @ T_lidar_base}
    nodes, sigmas = (*prior.nodes, BASE), {**prior.sigmas, BASE.name: _SIGMAS}
    prior = replace(prior, nodes=nodes, T=known, sigmas=sigmas, is_base_loose=True)
    return RigGraph((*graph.sensors, BASE), edges, graph.reference), prior


def _on_road(sweeps: Sequence[Sweep], heading_rad: float) -> Float[np.ndarray, "4 4"] | None:
    """T_lidar_base on the road under the lidar, x along the heading (azimuth in lidar axes); None without a road."""
    found = []
    for sweep in sweeps:
        p = sweep.xyz_m[sweep.is_ground]
        p = p[np.hypot(p[:, 0], p[:, 1]) < _NEAR_M]
        if len(p) >= _FEWEST_POINTS:
            level = np.column_stack([np.ones(len(p)), p[:, :2]])
            found.append(np.linalg.lstsq(level, p[:, 2], rcond=None)[0])
    if not found:
        return None
    height_m, along, aside = np.median(found, axis=0)
    z = np.array([-along, -aside, 1.0]) / np.hypot(1.0, np.hypot(along, aside))
    y = np.cross(z, [np.cos(heading_rad), np.sin(heading_rad), 0.0])
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    return from_rotation_translation(np.stack([x, y, z], 1), z * height_m * z[2] - _BEHIND_M * x)
