"""How camera-lidar is solved: kernel widths, steps and points of each stage, in one place."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SCHEDULE", "Schedule"]


@dataclass(frozen=True)
class Schedule:
    """Effort of each stage, in the order in which they run. Steps are local refinements, at most so many."""

    # Kernel width [label px] and contrast level, from wide to sharp.
    kernels: tuple[tuple[float, int], ...] = ((4.0, 0), (2.5, 1), (1.5, 2))

    # Basin: candidates of different origin climb at the first kernel above.
    wide_climb_steps: int = 4
    climb_steps: int = 6
    compared_points: int = 4000  # of each term, where ends are compared
    finishing_steps: int = 4  # of the best end, and of others that are no worse
    # Grid of rotations: kernel, step in kernels, points of each term, share of matching edges that it presumes.
    grid_kernel_deg: float = 0.6
    wide_grid_kernel_deg: float = 0.9  # beyond wide_box_deg
    wide_box_deg: float = 9.0
    grid_step_kernels: float = 1.5
    grid_points: int = 1500
    grid_frames: int = 24  # many points of few frames cost less than few points of many
    coarse_match: float = 0.1
    # How many of its poses by all terms together, and by each alone, are looked at with more points, and how many.
    grid_chosen: tuple[int, int] = (90, 20)
    chosen_points: int = 2000
    # Of its maxima so many are climbed, so far apart.
    grid_maxima: int = 4
    grid_apart_kernels: float = 3.0

    # Points of edges, and of markings: with wide kernels, with sharp ones, and for the time offset's profile, which is
    # sharp. More add nothing.
    wide_points: int = 8000
    sharp_points: int = 18000
    time_offset_points: int = 9000

    # Alignment.
    first_steps: int = 8
    sharper_steps: int = 4

    # Observability analysis: before and after the terms are weighted anew.
    steps_before_weights: int = 2
    steps_after_weights: int = 3

    # Profiles: steps of the other unknowns at each value of tz or time offset, and before the time offset's first.
    profile_steps: int = 1
    profile_start_steps: int = 2
    tz_values_per_side: int = 3
    tz_span_m: float = 0.36  # to each side
    time_offset_step_m: float = 0.2  # of way driven, ...
    time_offset_max_step_s: float = 0.012  # ... and at most
    time_offset_reach_s: float = 0.05
    time_offset_resamples: int = 200

    # Disjoint halves, from the solution of the whole.
    half_steps: int = 3
    # First and last part of the day, at each of two kernels.
    part_steps: int = 3


SCHEDULE = Schedule()
