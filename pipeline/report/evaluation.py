"""The page of `evaluate`: the paper's tables with its printed numbers, and views like its figures 1 to 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from pipeline.report.above import top_view
from pipeline.report.encode import jpeg_uri
from pipeline.report.overlays import Extrinsics, Scene, front_view, whole_view
from pipeline.report.page import render
from pipeline.report.svg import MUTED, Plot, document
from pipeline.report.words import PAIR_TITLES
from schemas.calibrations import PAIRS

__all__ = ["EvaluatedRun", "TableView", "View", "evaluation_page"]

_COLOURS = {
    "joint": "#1f6fc0",
    "tracking": "#8a4fb5",
    "pairwise-optimisation": "#b08000",
    "joint-optimisation": "#d0601c",
    "pairwise-ssl": "#2f9e6a",
    "joint-ssl": "#c23b52",
}
_DECADES = (0.001, 0.01, 0.1, 1.0, 10.0)
_AHEAD_M = 50.0


@dataclass(frozen=True)
class TableView:
    """One table; lines with the paper's printed numbers are marked."""

    title: str
    header: Sequence[str]
    lines: Sequence[tuple[bool, Sequence[str]]]  # from the paper?, cells


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """One run's errors, by pair: azimuth and elevation [deg] and range [m]; and its positions of the reflectors."""

    label: str
    method: str
    errors: dict[str, Float[np.ndarray, " 3"]]
    prior_errors: dict[str, Float[np.ndarray, " 3"]]
    # Lidar coordinates [m]: the reflectors, and the radar's measurement of them carried over by prior and result.
    reflectors_m: Float[np.ndarray, "K 3"]
    by_prior_m: Float[np.ndarray, "K 3"]
    by_result_m: Float[np.ndarray, "K 3"]


@dataclass(frozen=True, eq=False)
class View:
    """One frame at the prior and at the result; `split` puts both into one picture, each its half."""

    title: str
    scene: Scene
    before: Extrinsics
    after: Extrinsics
    split: bool = True
    caption: str = ""


@dataclass(frozen=True)
class _Pictures:
    title: str
    caption: str
    fronts: list[tuple[str, str]] = field(default_factory=list)  # words, data URI
    tops: list[tuple[str, Markup]] = field(default_factory=list)


def evaluation_page(
    tables: Sequence[TableView],
    runs: Sequence[EvaluatedRun],
    views: Sequence[View],
    normalised: dict[str, Float[np.ndarray, " N"]],
    notes: Sequence[str],
    no_views: str = "",
) -> str:
    """HTML of the whole page, no outside resources.

    Args:
        normalised: by method, errors over their own sigmas of all observable DoF; empty if truth is
            positions.
        notes: source of the truth, and other notes on the tables.
    """
    methods = [m for m in _COLOURS if any(r.method == m for r in runs)]
    return render(
        "evaluation.html",
        tables=tables,
        notes=notes,
        runs=len(runs),
        methods=[(m, _COLOURS[m]) for m in methods],
        errors_svg=_errors(runs) if runs else "",
        setup_svg=_setup(runs[0]) if runs else "",
        setup_run=f"{runs[0].label}, {runs[0].method}" if runs else "",
        coverage_svg=_coverage(normalised) if normalised else "",
        views=[_draw(v) for v in views],
        no_views=no_views,
    )


def _draw(view: View) -> _Pictures:
    """Both states in one picture, as in figures 1 and 3, or one above the other, as in figure 4."""
    labels = ("uncalibrated", "calibrated")
    pictures = _Pictures(view.title, view.caption)
    if view.split:
        words = f"left {labels[0]}, right {labels[1]}"
        pictures.fronts.append((words, jpeg_uri(front_view(view.scene, view.before, view.after, labels))))
        pictures.tops.append((words, top_view(view.scene, view.before, view.after, labels)))
        return pictures
    for word, state in zip(labels, (view.before, view.after), strict=True):
        pictures.fronts.append((word, jpeg_uri(whole_view(view.scene, state, word), 900)))
        pictures.tops.append((word, top_view(view.scene, state, state, (word, word))))
    return pictures


def _errors(runs: Sequence[EvaluatedRun]) -> Markup:
    """Azimuth against elevation error of every run, per pair, both on logarithmic axes; the priors as crosses."""
    parts: list[str] = []
    for k, pair in enumerate(PAIRS):
        plot = Plot(48.0 + 330.0 * k, 30.0, 262.0, 250.0, (-3.0, 1.0), (-3.0, 1.0))
        ticks = [(float(np.log10(d)), f"{d:g}") for d in _DECADES]
        plot.frame(ticks, ticks)
        plot.text(plot.left, 20.0, PAIR_TITLES[pair], bold=True, size=13.0)
        plot.text(plot.left + 131.0, 312.0, "error [deg]: azimuth across, elevation up", anchor="middle")
        for run in runs:
            plot.cross(*_logs(run.prior_errors[pair]), _tooltip(run, "prior", run.prior_errors[pair]))
        for run in runs:
            value = run.errors[pair]
            plot.dot(
                *_logs(value), _COLOURS.get(run.method, MUTED), _tooltip(run, run.method, value), radius=4.0
            )
        parts += plot.parts
    return document(1000.0, 322.0, parts, "Azimuth and elevation error of every run, by pair")


def _logs(error: np.ndarray) -> tuple[float, float]:
    azimuth, elevation = np.log10(np.clip(error[:2], _DECADES[0], _DECADES[-1]))
    return float(azimuth), float(elevation)


def _tooltip(run: EvaluatedRun, what: str, error: np.ndarray) -> str:
    return f"{run.label}, {what}: {error[0]:.3f} / {error[1]:.3f} deg"


def _setup(run: EvaluatedRun) -> Markup:
    """The controlled setup from above: reflectors as triangles, their radar measurements as circles (figure 2b)."""
    plot = Plot(60.0, 16.0, 520.0, 430.0, (-15.0, 15.0), (0.0, _AHEAD_M))
    plot.frame(
        [(float(x), f"{-x:g}") for x in range(-15, 16, 5)], [(float(y), f"{y:g}") for y in range(0, 51, 10)]
    )
    plot.text(320.0, 480.0, "y of the lidar [m]; up: x [m]", anchor="middle")
    for true, prior, result in zip(run.reflectors_m, run.by_prior_m, run.by_result_m, strict=True):
        u, v = plot.at(-float(true[1]), float(true[0]))
        plot.parts.append(f'<path d="M{u:.1f} {v - 9:.1f}l8 14h-16z" fill="#2f9e6a"/>')
        for place, colour, word in ((prior, MUTED, "prior"), (result, "#1f6fc0", "result")):
            gap = 100 * float(np.linalg.norm(place - true))
            plot.line((-true[1], true[0]), (-place[1], place[0]), "#c23b52", 1.4)
            plot.dot(-place[1], place[0], colour, f"{word}: {gap:.1f} cm off", radius=4.5, opacity=0.85)
    for k, (colour, word) in enumerate(
        (("#2f9e6a", "reflector"), (MUTED, "by the prior"), ("#1f6fc0", "by the result"))
    ):
        mark = "<circle cx='600' cy='{}' r='5'" if k else "<path d='M600 23l7 12h-14z'"
        plot.parts.append(f"{mark.format(30 + 20 * k)} fill='{colour}'/>")
        plot.text(612.0, 34.0 + 20.0 * k, word)
    return document(
        720.0, 490.0, plot.parts, "Reflectors from above, and their positions by prior and result"
    )


def _coverage(normalised: dict[str, np.ndarray]) -> Markup:
    """Share of errors within k sigma against k, per method; grey: the shares for correct sigmas."""
    plot = Plot(48.0, 16.0, 560.0, 260.0, (0.0, 4.0), (0.0, 1.0))
    plot.frame([(float(k), f"{k}") for k in range(5)], [(q, f"{q:.0%}") for q in (0.0, 0.25, 0.5, 0.75, 1.0)])
    plot.text(328.0, 308.0, "error within this many of its own sigmas", anchor="middle")
    grid = np.linspace(0.0, 4.0, 81)
    draws = np.abs(np.random.default_rng(0).standard_normal(20_000))
    _curve(plot, grid, draws, MUTED, 3.0)
    for method, z in normalised.items():
        _curve(plot, grid, np.abs(z), _COLOURS.get(method, MUTED), 1.8)
    return document(640.0, 316.0, plot.parts, "Share of errors within k of their own sigmas")


def _curve(plot: Plot, grid: np.ndarray, z: np.ndarray, colour: str, width: float) -> None:
    share = [float(np.mean(z <= g)) for g in grid]
    points = " ".join("{:.1f},{:.1f}".format(*plot.at(float(g), s)) for g, s in zip(grid, share, strict=True))
    plot.parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width:g}"/>')
