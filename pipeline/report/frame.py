"""A page about one frame: a network's estimate after an abrupt change, like the paper's figure 4."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.report.above import top_view
from pipeline.report.encode import jpeg_uri
from pipeline.report.overlays import Extrinsics, Scene, whole_view
from pipeline.report.page import render, write_page
from pipeline.report.pictures import close_ups_of
from pipeline.rig.estimates import Prior, Solution
from schemas.calibrations import DOF_NAMES, PAIRS

__all__ = ["write_frame_page"]

_LABELS = ("before", "from this frame")


def write_frame_page(path: Path, scene: Scene, prior: Prior, solution: Solution, title: str) -> Path:
    """Write pictures at the prior and at the solution, and the sigmas of each pair from one frame."""
    before = Extrinsics(*(prior.of(pair) for pair in PAIRS))
    after = Extrinsics(*(solution.pairs[pair].T for pair in PAIRS))
    views = [
        {
            "label": label,
            "front": jpeg_uri(whole_view(scene, state, label)),
            "top": top_view(scene, state, state, (label, label)),
        }
        for label, state in zip(_LABELS, (before, after), strict=True)
    ]
    html = render(
        "frame.html",
        title=title,
        method=solution.method,
        labels=_LABELS,
        views=views,
        close_ups=close_ups_of(scene, before, after),
        pairs=[_told(pair, prior, solution) for pair in PAIRS],
    )
    return write_page(path, html)


def _told(pair: str, prior: Prior, solution: Solution) -> dict[str, str]:
    """Text of the page about a pair."""
    estimate, T = solution.pairs[pair], prior.of(pair)
    R = estimate.T[:3, :3] @ T[:3, :3].T
    turned_deg = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0)))
    shifted_m = float(np.linalg.norm(estimate.T[:3, 3] - T[:3, 3]))
    sigma = np.sqrt(np.diag(estimate.covariance))
    seen = zip(DOF_NAMES[:3], sigma[:3], estimate.observable[:3], strict=True)
    known = [f"{name} {np.degrees(s):.2f} deg" for name, s, observable in seen if observable]
    return {
        "title": pair.replace("_", "-"),
        "moved": f"{turned_deg:.2f} deg and {shifted_m:.3f} m from before",
        "known": ", ".join(known) if known else "nothing: the prior stays",
        "matrix": "\n".join("  ".join(f"{v: .6f}" for v in row) for row in estimate.T),
    }
