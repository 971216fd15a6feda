"""How far around the prior a solver must look: by the prior's sigma, at least as far as configured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior

__all__ = ["SearchRange", "search_range"]

# Half-width of the searched box per axis, in sigmas of the prior. Rotation: 95 % of what the prior allows. Translation:
# half a metre changes the directions of most points by a degree or two only, which local refinement covers.
_SIGMAS_ROTATION, _SIGMAS_TRANSLATION = 2.0, 1.2


class SearchRange(NamedTuple):
    """Half-widths of the searched box per axis."""

    rotation_rad: float
    translation_m: float


def search_range(prior: Prior, config: SolveConfig) -> SearchRange:
    """The box to search.

    `solve.search_rotation_deg` and `solve.search_translation_m` are the least that is searched: whoever states that the
    prior may be off by 15 deg need not say it twice.
    """
    rotation = max(float(np.radians(config.search_rotation_deg)), _SIGMAS_ROTATION * prior.rotation_sigma_rad)
    translation = max(config.search_translation_m, _SIGMAS_TRANSLATION * prior.translation_sigma_m)
    return SearchRange(min(rotation, np.pi), translation)
