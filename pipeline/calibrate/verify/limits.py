"""Thresholds of the verdict, in one place."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.calibrate.select.frames import MIN_FRAMES

__all__ = ["UNCHECKED_MOVE_SIGMAS", "VerdictLimits"]

# Of its own sigmas, from which a move that nothing checks is named: chance does that once in 370 records. The prior's
# sigma does not excuse it: whoever loads the result exchanges the one for the other.
UNCHECKED_MOVE_SIGMAS = 3.0


@dataclass(frozen=True)
class VerdictLimits:
    """From where on a check of a pair fails; how exact it must be is `*_limit_deg` and `confidence` of `[verify]`.

    Chosen on simulated days of seeds 140 to 145 (demo and paper rig, 40 frames; 24 good days and 28 with faults), and
    on the real day for the question what methods that are 0.3 to 0.8 deg off look like.

    `prior_sigmas` are sigmas of the prior, other `sigmas` those of the quantity itself; `z` is a one-sided normal
    deviate of the paired test on held-out frames.
    """

    # A move this large happens once in 16,000 days if the prior's sigma is right.
    max_move_prior_sigmas: float = 4.0
    # z above which held-out frames align worse than at the prior. One-sided 1 %: a right result near a good prior
    # aligns worse by chance.
    worse_alignment_z: float = 2.33
    # -z from which they align better. One-sided 16 %: short days hold out some ten frames, and 5 % would hold right
    # results that moved by 10 cm.
    better_alignment_z: float = 1.0
    # A result within so many of its sigmas of the prior need not align better; the largest of six degrees of freedom.
    prior_agreement_sigmas: float = 4.0
    # Frames of the fit: with fewer the record is refused.
    min_fit_frames: int = MIN_FRAMES
    # Frames, and blocks of frames that share a scene, without which held-out data decide nothing.
    min_held_out_frames: int = 3
    min_held_out_blocks: int = 3
    # Held-out frames that would move the result by more of that move's sigmas contradict it.
    held_out_contradiction_sigmas: float = 3.0
    # An open loop of three independent estimates is an error of one of them beyond so many sigmas of the loop.
    max_loop_sigmas: float = 3.0
    # Camera-lidar was solved along the prior's heading: beyond so many of its sigmas that heading was wrong ...
    heading_change_prior_sigmas: float = 3.0
    # ... and the record is held where this costs more than this share of `camera_lidar_limit_deg`.
    max_heading_error_share: float = 0.25
