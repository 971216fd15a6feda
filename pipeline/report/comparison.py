"""The page of `boresight compare`: two calibrations, axis by axis; and the top of the page of `verify`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.report.page import render
from pipeline.report.words import ANSWERS, dof_title, scaled, unit_of
from pipeline.rig.targets import PairDifference
from schemas.calibrations import DOF_NAMES

__all__ = ["comparison_page", "in_use_view"]

_CLEAR_SIGMAS = 3.0
_REACH = 6.0  # sigmas to either side that a bar has room for
_WIDTH, _HEIGHT = 240, 18  # px of a bar
_MOODS = {"pass": "good", "warn": "partly", "fail": "bad", "inconclusive": "none"}
_MOOD_OF = {"right": "good", "wrong": "bad", "inconclusive": "partly"}


def comparison_page(first: str, second: str, pairs: Sequence[PairDifference], notes: Sequence[str]) -> str:
    """HTML of the change from one calibration to another."""
    views = [_view(p) for p in pairs]
    return render(
        "comparison.html",
        first=first,
        second=second,
        known=any(p.sigma is not None for p in pairs),
        clear=[f"{v['title']} {axis['title']}" for v in views for axis in v["axes"] if axis["beyond"]],
        notes=notes,
        pairs=views,
    )


def _view(p: PairDifference) -> dict[str, Any]:
    azimuth, elevation = np.degrees(p.targets_rad)
    axes = []
    for k, dof in enumerate(DOF_NAMES):
        z = None if p.z is None else float(p.z[k])
        axes.append(
            {
                "title": dof_title(p.edge.kind, dof),
                "change": f"{scaled(p.change[k], dof):+.4f} {unit_of(dof)}",
                "sigma": "" if p.sigma is None else f"{scaled(p.sigma[k], dof):.4f}",
                "z": "" if z is None else f"{z:+.1f}",
                "beyond": z is not None and abs(z) > _CLEAR_SIGMAS,
                "determined": bool(p.determined[k]),
                "bar": "" if z is None else _bar(z),
            }
        )
    return {
        "title": p.edge.name,
        "statuses": p.statuses,
        "targets": f"{azimuth:.3f} deg in azimuth, {elevation:.3f} deg in elevation",
        "axes": axes,
    }


def _bar(z: float) -> Markup:
    """A bar from 0 to z, cut at six sigmas; the band of three sigmas is grey behind it."""
    middle, unit = _WIDTH / 2, _WIDTH / 2 / _REACH
    end = middle + float(np.clip(z, -_REACH, _REACH)) * unit
    left, width = min(middle, end), max(abs(end - middle), 1.0)
    colour = "var(--bad)" if abs(z) > _CLEAR_SIGMAS else "var(--good)"
    band = _CLEAR_SIGMAS * unit
    return Markup(  # noqa: S704 (numbers of our own)
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img" '
        f'aria-label="{z:+.1f} sigma">'
        f'<rect x="{middle - band:.1f}" y="2" width="{2 * band:.1f}" height="{_HEIGHT - 4}" fill="var(--none-bg)"/>'
        f'<rect x="{left:.1f}" y="5" width="{width:.1f}" height="{_HEIGHT - 10}" fill="{colour}"/>'
        f'<line x1="{middle}" y1="1" x2="{middle}" y2="{_HEIGHT - 1}" stroke="var(--soft)"/></svg>'
    )


def in_use_view(
    answer: str, checks: Sequence[Mapping[str, Any]], errors: Sequence[str] = ()
) -> dict[str, Any]:
    """The page's first screen, from the answer, the checks and the errors in the JSON of `boresight verify`."""
    rows = [_row(check) for check in checks]
    unsure = ", ".join(f"{r['pair']} {r['axis']}" for r in rows if r["status"] == "inconclusive")
    sentences = [ANSWERS["wrong sensor"].format(error=e) for e in errors]
    sentences += [ANSWERS["open"].format(axes=unsure)] if unsure else []
    explained = " ".join(sentences) or ANSWERS["passes"]
    return {"mood": _MOOD_OF[answer], "headline": ANSWERS[answer], "explained": explained, "rows": rows}


def _row(check: Mapping[str, Any]) -> dict[str, Any]:
    """A check with its angles in words, and the class of the page's colours."""
    # Kinds of sensors have a dash between them; names stay as they are.
    pair = check["pair"].replace("_", "-") if check["pair"] == check["kind"] else check["pair"]
    angles = {name: _deg(abs(check[f"{name}_rad"])) for name in ("off", "sigma", "limit", "shown")}
    return {**check, **angles, "pair": pair, "mood": _MOODS[check["status"]]}


def _deg(angle_rad: object) -> str:
    if not isinstance(angle_rad, float) or not math.isfinite(angle_rad):
        return "unknown"
    return f"{np.degrees(angle_rad):.2f} deg"
