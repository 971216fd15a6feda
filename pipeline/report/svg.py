"""Small charts as inline SVG: text in the page's font and colour, every dot with its number as a tooltip.

Written by hand because a page holds dozens of tiny panels: matplotlib takes seconds for them, this takes milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup, escape

__all__ = ["MUTED", "Plot", "document", "nice_step"]

MUTED = "#8a8f98"
Number = float | int  # a position in the drawing


def nice_step(span: float) -> float:
    """A step of 1, 2 or 5 times a power of ten that fits two to five times into `span`."""
    power = 10.0 ** np.floor(np.log10(max(span, 1e-12)))
    return float(next(power * m for m in (0.2, 0.5, 1.0, 2.0) if span / (power * m) <= 5))


def document(width: Number, height: Number, parts: Sequence[str], description: str) -> Markup:
    """One `<svg>` element that scales with the page."""
    size = f'viewBox="0 0 {width:g} {height:g}" font-size="11" fill="currentColor"'
    head = f'<svg {size} role="img" aria-label="{escape(description)}">'
    return Markup(head + "".join(parts) + "</svg>")  # noqa: S704 (every text went through escape)


@dataclass
class Plot:
    """One panel: a rectangle of the drawing and the data range that it shows; drawing calls add to `parts`."""

    left: Number
    top: Number
    width: Number
    height: Number
    x: tuple[Number, Number]
    y: tuple[Number, Number]
    parts: list[str] = field(default_factory=list)

    def at(self, x: Number, y: Number) -> tuple[Number, Number]:
        """Position of a data point in the drawing."""
        u = (x - self.x[0]) / (self.x[1] - self.x[0])
        v = (y - self.y[0]) / (self.y[1] - self.y[0])
        return self.left + u * self.width, self.top + (1 - v) * self.height

    def line(
        self,
        start: tuple[Number, Number],
        end: tuple[Number, Number],
        colour: str,
        width: Number = 1.0,
    ) -> None:
        """A line between two data points."""
        (x0, y0), (x1, y1) = self.at(*start), self.at(*end)
        self.parts.append(
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" '
            f'stroke="{colour}" stroke-width="{width:g}"/>'
        )

    def area(
        self,
        low: tuple[Number, Number],
        high: tuple[Number, Number],
        colour: str,
        opacity: Number,
        outline: str = "none",
    ) -> None:
        """A filled rectangle between two data points."""
        (x0, y1), (x1, y0) = self.at(*low), self.at(*high)
        self.parts.append(
            f'<rect x="{x0:.1f}" y="{y0:.1f}" width="{max(x1 - x0, 0.5):.1f}" height="{max(y1 - y0, 0.5):.1f}" '
            f'fill="{colour}" fill-opacity="{opacity:g}" stroke="{outline}"/>'
        )

    def dot(
        self,
        x: Number,
        y: Number,
        colour: str,
        tooltip: str,
        *,
        radius: Number = 3.0,
        opacity: Number = 1.0,
    ) -> None:
        """A dot with a tooltip."""
        u, v = self.at(x, y)
        title = f"<title>{escape(tooltip)}</title>"
        circle = f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:g}" fill="{colour}"/>'
        self.parts.append(f'<g opacity="{opacity:g}">{title}{circle}</g>')

    def cross(self, x: Number, y: Number, tooltip: str) -> None:
        """A muted x, for what is missing."""
        u, v = self.at(x, y)
        self.parts.append(
            f'<g stroke="{MUTED}" stroke-width="1.3"><title>{escape(tooltip)}</title>'
            f'<path d="M{u - 3:.1f} {v - 3:.1f}l6 6m0 -6l-6 6" fill="none"/></g>'
        )

    def text(
        self,
        u: Number,
        v: Number,
        text: str,
        *,
        anchor: str = "start",
        colour: str = "currentColor",
        size: Number = 11.0,
        bold: bool = False,
    ) -> None:
        """Text at a position of the drawing (not of the data)."""
        weight = ' font-weight="600"' if bold else ""
        self.parts.append(
            f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="{anchor}" fill="{colour}" font-size="{size:g}"{weight}>'
            f"{escape(text)}</text>"
        )

    def frame(self, x_ticks: Sequence[tuple[Number, str]], y_ticks: Sequence[tuple[Number, str]]) -> None:
        """Left and lower axis, light grid, tick labels."""
        for value, label in x_ticks:
            self.line((value, self.y[0]), (value, self.y[1]), MUTED, 0.3)
            u, v = self.at(value, self.y[0])
            self.text(u, v + 13, label, anchor="middle", size=10.0)
        for value, label in y_ticks:
            self.line((self.x[0], value), (self.x[1], value), MUTED, 0.3)
            u, v = self.at(self.x[0], value)
            self.text(u - 5, v + 3.5, label, anchor="end", size=10.0)
        self.line((self.x[0], self.y[0]), (self.x[1], self.y[0]), MUTED)
        self.line((self.x[0], self.y[0]), (self.x[0], self.y[1]), MUTED)
