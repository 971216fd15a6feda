"""How lidar-radar is solved: scan, annealing and last steps, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

__all__ = ["SCHEDULE", "Schedule"]


@dataclass(frozen=True)
class Schedule:
    """Steps, sigmas and frames of each stage, in the order in which they run."""

    # Scan of turns about the vertical, by the cost of a few frames: enough to separate basins.
    scan_step_deg: float = 1.5
    scan_least_deg: float = 6.0  # searched at least
    scan_reach: float = 1.7  # times the search range: corners of the box
    scan_frames: int = 24
    scan_widen: tuple[float, float, float] = (
        2.0,
        3.0,
        2.0,
    )  # of the starting sigmas: azimuth, elevation, range
    stride: int = 3  # use every n-th detection in scan and annealing

    # Annealing: Newton steps with re-association, from wide sigmas to the radar's own.
    many_frames: int = 60  # from here on half of them find the basin
    widest: float = 4.0  # times the radar's sigmas
    cooling: float = 0.75  # per step
    anneal_steps: int = 14
    wide_em_share: float = 1.0  # share of EM's step in Newton's, while sigmas are wide ...
    sharp_em_share: float = 0.5  # ... and after
    # After so many steps the time offset is scanned, with so many times the starting sigmas.
    dt_scans: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({4: 1.5, 8: 0.8, 11: 0.5}))
    dt_scan_step_m: float = 0.25  # of way driven ...
    dt_compare_step_m: float = 0.2  # ... and when solutions are compared at other time offsets
    # To each side, whose median a dip is measured against: 1.5 m of way, sharp sigmas reach 0.5.
    dt_dip_steps: int = 6
    least_scan_speed_mps: float = 8.0  # slower cars need no finer steps of time

    # Last steps, with all detections.
    final_steps: int = 20
    final_em_share: float = 0.15
    converged: float = 0.003  # of the step limit: 0.1 ms, 0.5 mm, 0.01 deg
    sharpen_every: int = 3  # steps between updates of the radar's sigmas, in the first half of the last steps
    sigmas_converged: float = 0.02  # relative change of the radar's sigmas


SCHEDULE = Schedule()
