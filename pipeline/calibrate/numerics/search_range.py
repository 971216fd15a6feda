"""How far around the prior a solver must look: as far as the prior's sigma says, at least as the config says."""

from __future__ import annotations

import numpy as np

from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior

__all__ = ["search_range"]

# Half-width of the searched box per axis, in sigmas of the prior. Rotations: 95 % of what the prior allows. Shifts are
# no reason to lose the basin, as half a metre is a degree or two to most of what is seen; they are climbed to.
_SIGMAS_ROTATION, _SIGMAS_SHIFT = 2.0, 1.2


def search_range(prior: Prior, config: SolveConfig) -> tuple[float, float]:
    """Half-widths of the searched box per axis, rotation [rad] and translation [m].

    `solve.search_rotation_deg` and `solve.search_translation_m` are the least that is searched: whoever states that the
    prior may be off by 15 deg need not say it twice.
    """
    rotation = max(float(np.radians(config.search_rotation_deg)), _SIGMAS_ROTATION * prior.rotation_sigma_rad)
    return min(rotation, np.pi), max(config.search_translation_m, _SIGMAS_SHIFT * prior.translation_sigma_m)
