"""Kernel settings of the camera-lidar score: width, and assumed shares of matches and chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.objective.camera_lidar.points import EDGE_KINDS

__all__ = ["CHANCE_BINS", "MAX_GAP_PX", "WIDEST_GAP_RAD", "KernelSettings"]

CHANCE_BINS = 128
# Between rows further apart than this (16 rings: 30 px) a silhouette lies anywhere: such edges err by more than their
# curvature says, and have a weight of their own.
MAX_GAP_PX = 5.0
# What keeps one height (a hedge, roofs of cars afar) is off by the same part of the gap in every scene, of which no
# scatter over frames tells. Days of 8 scenes: rows 1 deg apart tell pitch within 1.8 sigma (20 days); of rows 1.33 deg
# apart 6 of 8 days were beyond 2 sigma (.56 to .94 deg), and 2 deg apart .83 deg at a sigma of .17.
WIDEST_GAP_RAD = np.radians(1.1)
# Chance density of an edge's distance before the data has been asked: boundaries every hundred pixels.
_EVEN_CHANCE = np.full((EDGE_KINDS, CHANCE_BINS), 1 / 100, np.float32)


@dataclass(frozen=True, eq=False)
class KernelSettings:
    """Kernel scale, contrast map, mixture shares and weights of the score's terms."""

    sigma_px: float  # scale of the edges' kernel, pixels of the label image
    contrast_level: int  # index into CONTRAST_BLURS_PX: which blur of the road contrast the markings see
    match: np.ndarray  # share of matching edges by kind
    chance: np.ndarray  # K B: density of |r| at random places [1/px], by kind, in bins of one pixel
    delta: float = 0.4  # contrast that marked points see more than the road, in standard deviations
    edge_weight: float = 1.0
    marking_weight: float = 1.0
    wide_share: float = 1.0  # weight of edges wider than MAX_GAP_PX, in units of that of the others

    @staticmethod
    def wide(sigma_px: float, contrast_level: int, match: float = 0.25) -> KernelSettings:
        """Settings that presume nothing of the data: one share of matches and even chance for all kinds of edges."""
        return KernelSettings(sigma_px, contrast_level, np.full(EDGE_KINDS, match, np.float32), _EVEN_CHANCE)
