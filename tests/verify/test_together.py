"""Logs of the same calibration are summed: what they share is not averaged, and scatter between them counts."""

import numpy as np
import pytest

from pipeline.verify.together import one_verdict_each, scatter
from schemas.set_checks import SetCheck

DEG = np.pi / 180


def rows(offs_deg, sigma_deg=0.15, common_deg=0.05, shipped="s", turn="", z=None, **fields):
    return [
        SetCheck(
            **{
                "vehicle": "v", "day": "2026-03-02", "log": f"{k}.mcap", "rig": "r", "shipped": shipped, "turn": turn,
                "sensor": "camera", "kind": "camera_lidar", "axis": axis, "answer": "undecided",
                "status": "inconclusive", "off_rad": abs(off) * DEG, "signed_rad": off * DEG,
                "sigma_rad": sigma_deg * DEG, "common_rad": common_deg * DEG, "limit_rad": 0.2 * DEG,
                "asked_rad": 0.5 * DEG, "power": 0.3, "shown_rad": None, "beyond": 3.0, "held_out_z": z or {},
            } | fields
        )
        for k, off in enumerate(offs_deg)
        for axis in ("azimuth", "elevation")
    ]  # fmt: skip


def test_logs_that_decide_nothing_alone_decide_together_and_share_what_is_common():
    offs = (0.05, -0.1, 0.08, 0.0, -0.04, 0.06, 0.02, -0.07, 0.01)
    [azimuth, elevation] = one_verdict_each(rows(offs), 0.995)
    assert (azimuth.answer, azimuth.status, elevation.status) == ("right", "pass", "pass")
    assert (azimuth.fused, azimuth.fused_used) == (9, 9)
    alone = np.sqrt(0.15**2 - 0.05**2)
    assert azimuth.sigma_rad / DEG == pytest.approx(np.hypot(alone / 3, 0.05))
    many = one_verdict_each(rows(offs * 100), 0.995)[0]
    assert many.sigma_rad / DEG == pytest.approx(0.05, abs=0.002)
    wrong = one_verdict_each(rows([0.5 + off for off in offs]), 0.995)[0]
    assert (wrong.answer, wrong.status) == ("wrong", "fail")


def test_scatter_between_logs_widens_the_verdict():
    apart = one_verdict_each(rows((0.9, -0.9, 0.7, -0.7)), 0.995)[0]
    assert apart.sigma_rad / DEG > 0.35
    assert apart.status == "inconclusive"
    assert scatter(np.array([0.1, -0.1]), np.array([1.0, 1.0])) == 0


def test_only_logs_of_one_calibration_and_one_turn_are_summed():
    assert one_verdict_each(rows((0.0,)), 0.995) == []
    apart = [r for k in "ab" for r in rows((0.0,), shipped=k, log=f"{k}.mcap")]
    assert one_verdict_each(apart, 0.995) == []
    shipped = rows((0.0, 0.0))
    turned = rows((0.5, 0.5), turn="camera azimuth +0.5")
    assert {r.turn for r in one_verdict_each([*shipped, *turned], 0.995)} == {"", "camera azimuth +0.5"}
    assert {r.turn for r in one_verdict_each([*shipped, *turned[:2]], 0.995)} == {""}
    assert one_verdict_each([*shipped, *rows((0.0, 0.0), fault="mirrored", turn="x")], 0.995)[0].turn == ""


def test_logs_whose_held_out_frames_see_no_turn_promise_nothing_together():
    blind = {"+0.5": 0.0, "-0.5": 0.0}
    found = one_verdict_each(rows((0.02,) * 9, sigma_deg=0.06, z=blind, power=0.01), 0.995)
    assert {(r.status, r.answer) for r in found} == {("inconclusive", "undecided")}
    silent = rows((0.0, 0.0), power=0.0)
    assert one_verdict_each(silent, 0.995)[0].fused_used == 0
