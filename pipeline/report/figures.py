"""Charts of the pages. Plain Figures without pyplot; the ink is the page's text colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pipeline.report.encode import INK
from pipeline.report.residuals import MEASURES
from pipeline.report.words import PAIR_TITLES, dof_title, scaled, unit_of
from schemas.calibrations import DOF_NAMES, PAIRS

__all__ = ["DriftPanel", "drift_figure", "residual_figure", "sigma_figure"]

BEFORE, AFTER, MUTED = "#e0813a", "#3b82c4", "#8a8f98"
STATUS_COLOURS = {"RED": "#d64550", "YELLOW": "#d9a21b", "GREEN": "#2f9e6a", "UNKNOWN": MUTED}
_SMALL = 8


@dataclass(frozen=True)
class DriftPanel:
    """One chart: day numbers and values in radians or metres, relative to the level before the change."""

    pair: str
    dof: str
    status: str
    day: Sequence[int]
    value: Sequence[float]
    sigma: Sequence[float]
    limit: float
    start: tuple[int, int, int] | None = None  # first day with the new value, earliest, latest
    missing: Sequence[int] = field(default=())  # held, refused or undetermined days


def sigma_figure(
    prior_sigma: Mapping[str, np.ndarray],
    sigma: Mapping[str, np.ndarray],
    observable: Mapping[str, Sequence[bool]],
) -> Figure:
    """Sigma of each DoF beside that of the prior; hollow where the day did not determine it."""
    figure = Figure(figsize=(11.4, 3.5), layout="constrained")
    axes = figure.subplots(2, 3, squeeze=False)
    for column, pair in enumerate(PAIRS):
        for row, dofs in enumerate((DOF_NAMES[:3], DOF_NAMES[3:])):
            ax = axes[row, column]
            _plain(ax)
            if pair not in sigma:
                ax.text(0.5, 0.5, "no estimate", transform=ax.transAxes, ha="center", color=INK)
            else:
                _sigma_bars(ax, pair, dofs, prior_sigma.get(pair), sigma[pair], observable[pair])
            if row == 0:
                ax.set_title(PAIR_TITLES[pair], fontsize=10, color=INK, loc="left", weight="bold")
            ax.set_xlabel(f"sigma [{unit_of(dofs[0])}]", fontsize=_SMALL, color=INK)
    return figure


def _sigma_bars(
    ax: Any,
    pair: str,
    dofs: Sequence[str],
    prior: np.ndarray | None,
    sigma: np.ndarray,
    observable: Sequence[bool],
) -> None:
    position = np.arange(len(dofs))
    index = [DOF_NAMES.index(d) for d in dofs]
    values = np.array([scaled(sigma[k], DOF_NAMES[k]) for k in index])
    if prior is not None:
        before = [scaled(prior[k], DOF_NAMES[k]) for k in index]
        ax.barh(position - 0.2, before, 0.36, color=MUTED, alpha=0.45)
    for p, k, v in zip(position, index, values, strict=True):
        seen = bool(observable[k])
        ax.barh(p + 0.2, v, 0.36, color=AFTER if seen else "none", edgecolor=AFTER, linewidth=1)
        text = f" {v:.2g}" if seen else f" {v:.2g}, not determined"
        ax.text(v, p + 0.2, text, va="center", fontsize=_SMALL, color=INK)
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(low, high * 6)  # room for the numbers
    ax.set_yticks(position, [dof_title(pair, d) for d in dofs])
    ax.invert_yaxis()


def residual_figure(before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> Figure:
    """Measures of `frame_residuals` over the day's frames."""
    figure = Figure(figsize=(11.4, 2.5), layout="constrained")
    axes = figure.subplots(1, 3, squeeze=False)[0]
    for ax, pair in zip(axes, PAIRS, strict=True):
        _plain(ax)
        name, more_is_better = MEASURES[pair]
        ax.set_title(PAIR_TITLES[pair], fontsize=10, color=INK, loc="left", weight="bold")
        ax.set_ylabel(name, fontsize=_SMALL, color=INK)
        ax.set_xlabel("frame, in order of time", fontsize=_SMALL, color=INK)
        for series, colour, label in ((before, BEFORE, "prior"), (after, AFTER, "calibrated")):
            values = series[pair]
            if np.isfinite(values).any():
                ax.plot(np.arange(len(values)), values, ".", color=colour, markersize=4, alpha=0.7)
                level = float(np.nanmedian(values))
                ax.axhline(level, color=colour, linewidth=1.4, label=f"{label}: median {level:.2g}")
        if ax.get_legend_handles_labels()[0]:
            hint = "more is better" if more_is_better else "less is better"
            legend = ax.legend(
                fontsize=_SMALL, title=hint, title_fontsize=_SMALL, framealpha=0.0, labelcolor=INK
            )
            legend.get_title().set_color(INK)
        else:
            ax.text(0.5, 0.5, "too little in view", transform=ax.transAxes, ha="center", color=INK)
    return figure


def drift_figure(panels: Sequence[DriftPanel], day_labels: Mapping[int, str]) -> Figure:
    """All charts of a vehicle: pairs down, DoFs across; bars are one sigma, the band is what matters."""
    figure = Figure(figsize=(13.0, 6.0), layout="constrained")
    axes = figure.subplots(len(PAIRS), len(DOF_NAMES), squeeze=False, sharex=True)
    for panel in panels:
        _drift_panel(axes[PAIRS.index(panel.pair), DOF_NAMES.index(panel.dof)], panel)
    days = sorted(day_labels)
    for ax in axes[-1]:
        shown = days if len(days) <= 4 else [days[0], days[len(days) // 2], days[-1]]
        ax.set_xticks(shown, [day_labels[d] for d in shown], fontsize=_SMALL - 1)
        ax.set_xlim(days[0] - 0.6, days[-1] + 0.6)
    for row, pair in enumerate(PAIRS):
        axes[row, 0].set_ylabel(PAIR_TITLES[pair], fontsize=10, color=INK, weight="bold")
    return figure


def _drift_panel(ax: Any, panel: DriftPanel) -> None:
    _plain(ax)
    colour = STATUS_COLOURS[panel.status]
    title = f"{dof_title(panel.pair, panel.dof)} [{unit_of(panel.dof)}]"
    alarmed = panel.status in ("RED", "YELLOW")
    ax.set_title(
        title,
        fontsize=_SMALL + 0.5,
        color=colour if alarmed else INK,
        loc="left",
        weight="bold" if alarmed else None,
    )
    for side in ("left", "bottom"):
        ax.spines[side].set_color(colour)
        ax.spines[side].set_linewidth(2.0 if alarmed else 1.0)
    limit = scaled(panel.limit, panel.dof)
    ax.axhspan(-limit, limit, color=STATUS_COLOURS["GREEN"], alpha=0.13, linewidth=0)
    if panel.start is not None:
        first, earliest, latest = panel.start
        ax.axvspan(earliest - 0.5, latest - 0.5 + 1e-3, color=colour, alpha=0.25, linewidth=0)
        ax.axvline(first - 0.5, color=colour, linewidth=1.2, linestyle="--")
    if len(panel.day):
        value = [scaled(v, panel.dof) for v in panel.value]
        sigma = [scaled(s, panel.dof) for s in panel.sigma]
        ax.errorbar(
            panel.day, value, sigma, fmt="o", color=colour, ecolor=colour, markersize=3.5, elinewidth=1.1
        )
        reach = 1.15 * max(*(abs(v) + s for v, s in zip(value, sigma, strict=True)), limit)
        ax.set_ylim(-reach, reach)
    else:
        ax.text(0.5, 0.6, "not determined", transform=ax.transAxes, ha="center", fontsize=_SMALL, color=MUTED)
        ax.set_ylim(-2 * limit, 2 * limit)
    ax.plot(panel.missing, np.zeros(len(panel.missing)), "x", color=MUTED, markersize=4)


def _plain(ax: Any) -> None:
    ax.patch.set_alpha(0.0)
    ax.tick_params(colors=INK, labelsize=_SMALL, length=3)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(INK)
    ax.grid(visible=True, color=MUTED, alpha=0.22, linewidth=0.6)
