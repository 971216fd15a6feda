"""One verdict for all logs that ship the same calibration: the evidence of a vehicle's logs, summed per axis.

The correlation of a log's frames is included in its sigma. Logs are not independent either: the part of a
sigma common to all logs of a vehicle (`common_rad`) is not averaged. If answers scatter by more than the rest
of their sigmas, this scatter is added to every log, so that a few logs with small sigmas do not dominate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.verify.axes import answers_by_sensor
from pipeline.verify.one_axis import AxisCheck, AxisLimits, HeldOut, checked, power_of, silent
from schemas.set_checks import SetCheck

__all__ = ["one_verdict_each", "scatter"]


def one_verdict_each(rows: Sequence[SetCheck], confidence: float) -> list[SetCheck]:
    """Rows of the verdicts over all logs of a vehicle with the same calibration, as shipped and with each turn.

    There are verdicts for two or more logs only; a turn is judged if it was applied to every log of the calibration.
    """
    groups: dict[tuple[str, ...], list[SetCheck]] = {}
    for r in rows:
        if r.sensor and not r.fault and not r.fused:
            groups.setdefault((r.vehicle, r.shipped, r.turn), []).append(r)
    found = []
    for (vehicle, shipped, _), own in groups.items():
        logs = {(r.day, r.log) for r in own}
        if len(logs) > 1 and logs == {(r.day, r.log) for r in groups.get((vehicle, shipped, ""), ())}:
            found += _verdict(own, len(logs), confidence)
    return found


def _verdict(rows: Sequence[SetCheck], logs: int, confidence: float) -> list[SetCheck]:
    axes: dict[tuple[str, str], list[SetCheck]] = {}
    for r in rows:
        axes.setdefault((r.sensor, r.axis), []).append(r)
    checks = [_together(own, confidence) for own in axes.values()]
    answers = answers_by_sensor([c for c, _ in checks])
    return [_row(own, c, used, logs, answers) for (c, used), own in zip(checks, axes.values(), strict=True)]


def _row(own: Sequence[SetCheck], c: AxisCheck, used: int, logs: int, answers: Mapping[str, str]) -> SetCheck:
    return replace(
        own[0],
        log=f"{logs} logs together",
        day=min(r.day for r in own),
        fused=logs,
        fused_used=used,
        work_key="",
        recorded_at="",
        asserted_at="",
        answer=answers[c.pair],
        status=c.status,
        reason=c.reason,
        power=c.power,
        off_rad=_known(c.off_rad),
        signed_rad=_known(c.signed_rad),
        sigma_rad=_known(c.sigma_rad),
        common_rad=c.common_rad,
        shown_rad=_known(c.shown_rad),
        held_out_z={},
        passes_rad={},
    )


def _together(rows: Sequence[SetCheck], confidence: float) -> tuple[AxisCheck, int]:
    """Verdict of one axis, and the number of logs with answers used for it."""
    first = rows[0]
    limits = AxisLimits(first.limit_rad or np.nan, first.asked_rad or np.nan, confidence)
    of = first.sensor, first.kind
    used = [r for r in rows if _says(r)]
    if not used:
        return silent(
            of, first.axis, limits, f"none of {len(rows)} logs gives an estimate: {first.reason}"
        ), 0
    x = np.array([r.signed_rad for r in used], float)
    common = max(r.common_rad or 0.0 for r in used)
    v = np.array([(r.sigma_rad or 0.0) ** 2 - (r.common_rad or 0.0) ** 2 for r in used])
    v = np.maximum(v, 1e-12)
    w = 1 / (v + scatter(x, v))
    mean, beyond = float(w @ x / w.sum()), max(r.beyond or 0.0 for r in used)
    sigma = float(np.sqrt(1 / w.sum() + common**2))
    check = checked(of, first.axis, limits, (mean, sigma, common), "", beyond)
    power = _power(used, w, common, limits, beyond)
    if check.status in {"pass", "warn"} and power < confidence:
        asked = np.degrees(limits.asked_rad)
        why = f"an error of {asked:.2f} deg would have been detected with probability {power:.1%}"
        check = replace(check, status="inconclusive", reason=f"{check.reason}: {why}")
    return replace(
        check, power=power, shown_rad=check.shown_rad if power >= confidence else float("nan")
    ), len(used)


def _says(row: SetCheck) -> bool:
    """Whether the log has an answer that can be compared."""
    return row.signed_rad is not None and row.sigma_rad is not None and bool(row.power)


def scatter(x: Float[np.ndarray, " L"], v: Float[np.ndarray, " L"]) -> float:
    """Variance of answers `x` in excess of their own variances `v`, by DerSimonian and Laird; 0 if they agree."""
    w = 1 / v
    q = float(w @ (x - w @ x / w.sum()) ** 2)
    spare = float(w.sum() - (w**2).sum() / w.sum())
    return max(0.0, (q - (len(x) - 1)) / spare) if spare > 0 else 0.0


def _power(
    rows: Sequence[SetCheck], w: Float[np.ndarray, " L"], common_rad: float, limits: AxisLimits, beyond: float
) -> float:
    """Probability that an error of `asked_rad` would have failed.

    A log with an answer many sigmas off counts only if its held-out frames confirm it; at least one log must count.
    """
    deg = float(np.degrees(limits.asked_rad))
    stays = np.array([_stays(r, limits.asked_rad, deg) for r in rows])
    left = float(w @ stays)
    if left <= 0:
        return 0.0
    sigma = float(np.sqrt(1 / left + common_rad**2))
    some = 1 - float(np.prod(1 - stays))
    return some * power_of(limits.asked_rad, limits.limit_rad, sigma, beyond)


def _stays(row: SetCheck, size_rad: float, deg: float) -> float:
    """Probability that a log's answer would not be held for lack of confirmation by held-out frames."""
    said = HeldOut({float(d): z for d, z in row.held_out_z.items()})
    return 1.0 if size_rad < said.agreement * (row.sigma_rad or 0.0) else said.confirms(deg)


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None
