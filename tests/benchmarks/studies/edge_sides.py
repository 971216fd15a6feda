"""Whether the edges of each side agree on a pitch: their score over pitch about a pose that is known.

    python tests/benchmarks/studies/edge_sides.py --fleet fleet.toml --lake LAKE --vehicle V --day D --truth truth.json

Where every jump in depth has a boundary in the labels, each side scores best at the true pose. Beams that pass through
windows and fences make jumps that no boundary explains, and the side that has them rises towards the next boundary.
The file of the truth holds T_camera_lidar at its top, or of a day's name. Positive pitch moves the points up.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import exp_so3, from_rotation_translation
from pipeline.objective.camera_lidar.score import (
    Alignments,
    KernelSettings,
    Terms,
    lidar_velocities,
    prepare_terms,
)
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT, Observation

__all__ = ["PITCH_DEG", "SIDES", "excess_over_pitch", "terms_of"]

SIDES: Final = {"left": EDGE_LEFT, "right": EDGE_RIGHT, "above": EDGE_ABOVE, "below": EDGE_BELOW}
PITCH_DEG: Final = np.arange(-8, 9) / 4
_REACH_RAD: Final = np.radians(3.0)


def terms_of(observations: Sequence[Observation], T_camera_lidar: Float[np.ndarray, "4 4"]) -> Terms:
    """The camera-lidar terms of a day about a pose; the car drives along the lidar's x axis."""
    velocity = lidar_velocities(observations, np.eye(4), 0.0)
    return prepare_terms(observations, T_camera_lidar, velocity, reach_rad=_REACH_RAD)


def excess_over_pitch(
    terms: Terms, T_camera_lidar: Float[np.ndarray, "4 4"], dt_s: float, sigma_px: float
) -> dict[str, Float[np.ndarray, " P"]]:
    """By side, what its edges score beyond chance at each of PITCH_DEG."""
    turns = exp_so3(np.radians(PITCH_DEG)[:, None] * [1.0, 0.0, 0.0])
    T = from_rotation_translation(turns, np.zeros((len(turns), 3))) @ T_camera_lidar
    at = Alignments(T, np.full(len(T), dt_s), np.ones(len(T)))
    kernel = KernelSettings.wide(sigma_px, 2)
    found = {}
    for name, side in SIDES.items():
        of_side = replace(terms, edges=terms.edges.chosen(terms.edges.side == side))
        found[name] = of_side.edge_excess(at, kernel).sum(axis=1)
    return found


def _truth(path: Path) -> tuple[np.ndarray, float]:
    """T_camera_lidar and the camera's time offset of a truth file, or of the only day in a file of given ones."""
    known: dict[str, Any] = json.loads(path.read_text())
    day = known if "T_camera_lidar" in known else next(iter(known.values()))
    return np.array(day["T_camera_lidar"]), float(day.get("dt_camera_lidar_s", 0.0))


def main() -> None:
    """Print a line per side."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in ("lake", "vehicle", "day"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--sigma-px", type=float, default=3.0)
    args = parser.parse_args()
    rows = list(observations_of(Lake.at(args.lake), Partition(args.vehicle, args.day)))
    T, dt_s = _truth(args.truth)
    terms = terms_of(rows, T)
    print("edges   " + "".join(f"{p:+7.2f}" for p in PITCH_DEG) + " deg")
    for name, excess in excess_over_pitch(terms, T, dt_s, args.sigma_px).items():
        count = int((terms.edges.side == SIDES[name]).sum())
        print(f"{name:6}{count:6d}" + "".join(f"{e:7.0f}" for e in excess))


if __name__ == "__main__":
    main()
