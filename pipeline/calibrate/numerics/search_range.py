"""How far around the prior a solver must look: by the prior's sigma, at least as far as configured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.core.config import SolveConfig

__all__ = ["SearchRange", "search_range"]

# Half-width of the searched box per axis, in sigmas of the prior. Rotation: 95 % of the prior. Translation:
# half a metre changes the directions of most points by a degree or two only, which local refinement covers.
_SIGMAS_ROTATION, _SIGMAS_TRANSLATION = 2.0, 1.2


class SearchRange(NamedTuple):
    """Half-widths of the searched box per axis."""

    rotation_rad: float
    translation_m: float


def search_range(prior_sigmas: tuple[float, float], config: SolveConfig) -> SearchRange:
    """The box to search, by the prior and at least `search_rotation_deg` and `search_translation_m`.

    Args:
        prior_sigmas: of rotation [rad] and translation [m], each axis.
    """
    rotation_rad, translation_m = prior_sigmas
    rotation = max(float(np.radians(config.search_rotation_deg)), _SIGMAS_ROTATION * rotation_rad)
    translation = max(config.search_translation_m, _SIGMAS_TRANSLATION * translation_m)
    return SearchRange(min(rotation, np.pi), translation)
