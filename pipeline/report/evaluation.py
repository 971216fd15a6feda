"""The page of `evaluate`: the paper's tables with its printed numbers, and views like its figures 1 to 4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from pipeline.report.overlays import Extrinsics, Scene, front_view, whole_view
from pipeline.report.page import render
from pipeline.report.pictures import jpeg_uri, top_view
from pipeline.report.reading import choose_frames
from pipeline.report.residuals import as_stamped, time_offsets_of
from pipeline.report.svg import MUTED, Plot, document
from pipeline.report.words import PAIR_TITLES
from pipeline.rig.se3 import transform_points
from pipeline.rig.targets import ComparedRun
from pipeline.store.current import prior_of, targets_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of, ingested, observations_of, perceived
from schemas.calibrations import PAIRS, CalibrationRecord

__all__ = ["EvaluatedRun", "View", "evaluation_page", "page_of_runs"]

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
_FAVOURITES = ("joint", "joint-ssl", "joint-optimisation")  # whose pictures are worth a look, best first


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


def evaluation_page(
    tables: Sequence[Mapping[str, Any]],
    runs: Sequence[EvaluatedRun],
    views: Sequence[View],
    normalised: dict[str, Float[np.ndarray, " N"]],
    notes: Sequence[str],
    no_views: str = "",
) -> str:
    """HTML of the whole page, no outside resources.

    Args:
        tables: title, header, and lines: whether the paper printed it, and its cells.
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


def _draw(view: View) -> dict[str, Any]:
    """Both states in one picture, as in figures 1 and 3, or one above the other, as in figure 4."""
    labels, states = ("uncalibrated", "calibrated"), (view.before, view.after)
    if view.split:
        words = f"left {labels[0]}, right {labels[1]}"
        fronts = [(words, jpeg_uri(front_view(view.scene, *states, labels)))]
        tops = [(words, top_view(view.scene, *states, labels))]
    else:
        of_each = list(zip(labels, states, strict=True))
        fronts = [(word, jpeg_uri(whole_view(view.scene, state, word), 900)) for word, state in of_each]
        tops = [(word, top_view(view.scene, state, state, (word, word))) for word, state in of_each]
    return {"title": view.title, "caption": view.caption, "fronts": fronts, "tops": tops}


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


def page_of_runs(lake: Lake, compared: Sequence[ComparedRun], texts: Mapping[str, str]) -> str:
    """HTML of the tables, of every run, and of a frame per environment where the lake still has frames.

    Args:
        lake: of the runs; frames and observations are read for the pictures.
        texts: tables as Markdown, by title; lines that begin with "- " are notes.
    """
    by_method: dict[str, list[np.ndarray]] = {}
    for c in compared:
        if len(c.comparison.normalised):
            by_method.setdefault(c.comparison.method, []).append(c.comparison.normalised)
    return evaluation_page(
        [_table(title, text) for title, text in texts.items()],
        [_evaluated(c) for c in compared],
        _views(lake, compared),
        {method: np.concatenate(parts) for method, parts in by_method.items()},
        [line[2:] for text in texts.values() for line in text.splitlines() if line.startswith("- ")],
        no_views="the lake no longer has the days' frames and observations",
    )


def _table(title: str, text: str) -> dict[str, Any]:
    """The lines of a Markdown table."""
    block = text.split("\n\n")[1].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in block if line.startswith("|")]
    lines = [(row[0].startswith("paper:"), row) for row in cells[2:]]
    return {"title": title, "header": cells[0], "lines": lines}


def _evaluated(compared: ComparedRun) -> EvaluatedRun:
    first = compared.run["lidar_radar"]
    T, T_prior = transform_of(first), prior_of(first)
    assert T is not None, "compared runs have a result"
    if compared.picks is not None:
        radar, lidar = compared.picks.radar_m, compared.picks.lidar_m
    else:
        assert compared.truth is not None, "either truth or picks"
        radar = targets_of(first)
        lidar = transform_points(compared.truth["lidar_radar"], radar)
    return EvaluatedRun(
        f"{first.vehicle} {first.day}",
        first.method,
        _in_degrees(compared.comparison.errors),
        _in_degrees(compared.comparison.prior_errors),
        lidar,
        transform_points(T if T_prior is None else T_prior, radar),
        transform_points(T, radar),
    )


def _in_degrees(errors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {pair: np.array([*np.degrees(errors[pair][:2]), errors[pair][2]]) for pair in PAIRS}


def _views(lake: Lake, compared: Sequence[ComparedRun]) -> list[View]:
    """A day of each environment, split into both states; and the run that started furthest off, state by state."""
    best = [c for c in compared if _rank(c) == min(map(_rank, compared))] if compared else []
    wanted = {
        c.comparison.environment: (c, f"{c.comparison.environment}: alignment", True) for c in reversed(best)
    }
    chosen = list(wanted.values())
    if best:
        worst = max(best, key=_start_deg)
        chosen.append((worst, f"Abrupt change: a start {_start_deg(worst):.1f} deg off", False))
    views = []
    for c, title, split in chosen:
        drawn = _scene(lake, c.run, another=not split)
        if drawn is not None:
            first = c.run["camera_lidar"]
            views.append(View(title, *drawn, split, f"{first.vehicle} {first.day}, {first.method}."))
    return views


def _rank(compared: ComparedRun) -> int:
    method = compared.comparison.method
    return _FAVOURITES.index(method) if method in _FAVOURITES else len(_FAVOURITES)


def _start_deg(compared: ComparedRun) -> float:
    """Largest error of the run's prior, azimuth or elevation of any pair."""
    return float(np.degrees(max(e[:2].max() for e in compared.comparison.prior_errors.values())))


def _scene(
    lake: Lake, run: Mapping[str, CalibrationRecord], *, another: bool
) -> tuple[Scene, Extrinsics, Extrinsics] | None:
    """A frame with much to see, and the run's two states, the result with its time offsets; None without frames."""
    first = run["camera_lidar"]
    partition = Partition(first.vehicle, first.day)
    if ingested(lake, partition) is None or perceived(lake, partition) is None:
        return None
    states = []
    for of in (prior_of, transform_of):
        known = [T for pair in PAIRS if (T := of(run[pair])) is not None]
        if len(known) < len(PAIRS):
            return None
        states.append(Extrinsics(*known))
    rows = list(observations_of(lake, partition))
    if not rows:
        return None
    picked = [rows[i] for i in choose_frames(rows, states[1].T_camera_lidar, 2)]
    o = picked[-1 if another else 0]
    frames = list(frames_of(lake, partition, [o.frame_index]))
    if not frames:
        return None
    return Scene(frames[0], o), states[0], as_stamped(states[1], o, time_offsets_of(run))
