"""The figures of a day's page: sigmas per axis, agreement per frame (control charts: `templates/fleet.js`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from pipeline.report.residuals import MEASURES
from pipeline.report.svg import MUTED, Plot, document, nice_step
from pipeline.report.words import PAIR_TITLES, dof_title, scaled, unit_of
from schemas.calibrations import DOF_NAMES, PAIRS

__all__ = ["SigmaPanel", "residual_figure", "sigma_figure"]

BEFORE, AFTER = "#e0813a", "#3b82c4"
_COLUMNS, _SIGMA_HEIGHT = 3, 272.0  # edges side by side, and the height of a row of them


@dataclass(frozen=True, eq=False)
class SigmaPanel:
    """One edge of the figure: title and kind, sigmas of prior and result (None = there is none), observed DoF."""

    title: str
    pair: str
    prior: np.ndarray | None
    sigma: np.ndarray | None
    observable: Sequence[bool] | None


def sigma_figure(panels: Sequence[SigmaPanel]) -> Markup:
    """Sigma of each DoF next to that of the prior, on a log scale; hollow if the day did not determine it."""
    parts: list[str] = []
    for place, panel in enumerate(panels):
        left, above = place % _COLUMNS * 410.0, place // _COLUMNS * _SIGMA_HEIGHT
        for row, dofs in enumerate((DOF_NAMES[:3], DOF_NAMES[3:])):
            known = [source for source in (panel.prior, panel.sigma) if source is not None]
            low, high = _decades([s for source in known for s in _page_units(source, dofs)])
            plot = Plot(left + 80.0, above + row * 132.0 + 24.0, 310.0, 84.0, (low, high), (3.0, 0.0))
            if row == 0:
                plot.text(left, above + 12.0, panel.title, bold=True, size=12.5)
            decades = [(float(d), f"{10.0**d:g}") for d in np.arange(np.ceil(low), high + 1e-9)]
            plot.frame(decades, [])
            unit = f"sigma [{unit_of(dofs[0])}], log"
            plot.text(plot.left + 310, plot.top + 110, unit, anchor="end", colour=MUTED)
            for k, dof in enumerate(dofs):
                plot.text(plot.left - 6, plot.top + 28 * k + 18, dof_title(panel.pair, dof), anchor="end")
                _sigma_bars(plot, k, DOF_NAMES.index(dof), panel.prior, panel.sigma, panel.observable)
            parts += plot.parts
    height = _SIGMA_HEIGHT * max(1, -(-len(panels) // _COLUMNS))
    return document(1210.0, height, parts, "Sigma of each degree of freedom, of the prior and of the result")


def _sigma_bars(
    plot: Plot,
    row: int,
    k: int,
    prior: np.ndarray | None,
    sigma: np.ndarray | None,
    observable: Sequence[bool] | None,
) -> None:
    low = plot.x[0]
    if prior is not None:
        end = float(np.log10(scaled(prior[k], DOF_NAMES[k])))
        plot.area((low, row + 0.48), (end, row + 0.14), MUTED, 0.45)
    if sigma is None or observable is None:
        return
    value = scaled(sigma[k], DOF_NAMES[k])
    end = float(np.log10(value))
    plot.area((low, row + 0.88), (end, row + 0.54), AFTER, 1.0 if observable[k] else 0.0, AFTER)
    u, v = plot.at(end, row + 0.71)
    plot.text(u + 5, v + 3.5, f"{value:.2g}" + ("" if observable[k] else " not determined"), size=10.0)


def residual_figure(
    before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], pairs: Sequence[str] = PAIRS
) -> Markup:
    """Measures of `frame_residuals` over the day's frames."""
    parts: list[str] = []
    for column, pair in enumerate(pairs):
        finite = np.concatenate([v[np.isfinite(v)] for v in (before[pair], after[pair])])
        # A few frames in poor surroundings must not flatten the rest.
        top = 1.1 * float(np.quantile(finite, 0.97)) if len(finite) else 1.0
        plot = Plot(
            column * 410.0 + 44.0, 40.0, 350.0, 130.0, (-1.0, float(len(before[pair]))), (0.0, max(top, 1e-6))
        )
        plot.text(column * 410.0, 12.0, PAIR_TITLES[pair], bold=True, size=12.5)
        plot.text(column * 410.0, 28.0, f"{MEASURES[pair]}; more is better", colour=MUTED)
        step = nice_step(plot.y[1])
        plot.frame([], [(float(y), f"{y:g}") for y in np.arange(0.0, plot.y[1], step)])
        if not len(finite):
            plot.text(plot.left + 175, 110.0, "too little in view", anchor="middle")
        for k, (series, colour, label) in enumerate(
            ((before, BEFORE, "prior"), (after, AFTER, "calibrated"))
        ):
            _residual_dots(plot, series[pair], colour, label, plot.left + 130 * k)
        parts += plot.parts
    return document(
        1210.0,
        192.0,
        parts,
        "Agreement of the sensors in each frame, at the prior and calibrated",
    )


def _residual_dots(plot: Plot, values: np.ndarray, colour: str, label: str, legend_u: float) -> None:
    if not np.isfinite(values).any():
        return
    level = float(np.nanmedian(values))
    for i in np.flatnonzero(np.isfinite(values)):
        y = min(float(values[i]), plot.y[1])
        plot.dot(float(i), y, colour, f"{label}: {values[i]:.3g}", radius=2.3, opacity=0.65)
    plot.line((plot.x[0], min(level, plot.y[1])), (plot.x[1], min(level, plot.y[1])), colour, 1.6)
    plot.text(legend_u, 186.0, f"{label}: median {level:.2g}", colour=colour, bold=True)


def _page_units(sigma: np.ndarray, dofs: Sequence[str]) -> list[float]:
    return [scaled(sigma[DOF_NAMES.index(d)], d) for d in dofs]


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Range of a log axis with room for bars on the left and numbers on the right."""
    if not values:
        return -3.0, 1.0
    return float(np.log10(min(values))) - 0.5, float(np.log10(max(values))) + 0.9
