"""How the mounts of a fleet move without a fault: scatter from day to day, and wander, learnt from their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.audit.days import DOFS, PairDays, charts_of_fleet, edges_of_fleet
from pipeline.audit.fusion import Mount
from pipeline.audit.noise import estimate_noise
from pipeline.audit.vehicle import limit_of
from pipeline.audit.wander import with_wander
from pipeline.core.config import AuditConfig
from pipeline.rig.graph import Edge
from schemas.calibrations import DOF_NAMES

__all__ = ["mounts_of"]

# A mount's scatter from day to day before any day shows more: another simulator's mounts have .03 to .05 deg; load,
# temperature and tyres move a car's sensors to its road by as much.
_SCATTER = np.array([*np.radians([0.03] * 3), 0.003, 0.003, 0.003])


def mounts_of(
    fleet: Sequence[Mapping[Edge, PairDays]], config: AuditConfig, models: Sequence[str]
) -> list[dict[Edge, Mount]]:
    """The mount of each sensor of each vehicle, by tie of sensor and reference."""
    edges = edges_of_fleet(fleet)
    if not edges:
        return [{} for _ in fleet]
    charts, shape = charts_of_fleet(fleet, edges), (len(fleet), len(edges), DOFS)
    limit = np.tile([limit_of(edge, dof, config) for edge in edges for dof in DOF_NAMES], len(fleet))
    noise = with_wander(charts, estimate_noise(charts, DOFS, len(edges), models), limit, shape, models)
    least = noise if noise.less_alike is None else noise.less_alike
    # Days that scatter by more than their sigmas do so because the mount does, or because the sigmas are too small:
    # either way tomorrow lies that far off.
    sigma = np.where(np.isfinite(charts.sigma), charts.sigma, np.nan)
    known = charts.count > 0
    typical = np.zeros(len(known))
    typical[known] = np.nanmedian(sigma[known], axis=1)
    beyond = ((noise.scale**2 - 1) * typical**2).reshape(shape)
    alike = (0.5 * (noise.autocorrelation + least.autocorrelation)).reshape(shape).mean(axis=-1)
    wander = np.zeros(shape) if noise.wander is None else noise.wander.reshape(shape)
    return [
        {
            edge: Mount(np.sqrt(_SCATTER**2 + beyond[v, p]), wander[v, p], float(alike[v, p]))
            for p, edge in enumerate(edges)
            if edge in own
        }
        for v, own in enumerate(fleet)
    ]
