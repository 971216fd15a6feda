"""Held-out frames decide, failed checks hold, and nothing worse than the prior passes."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.verify.edge_result import EdgeResult
from pipeline.calibrate.verify.held_out import HeldOutTest, paired_test
from pipeline.calibrate.verify.target_accuracy import DIRECTIONS, Claim
from pipeline.calibrate.verify.verdict import Evidence, judge
from pipeline.core.config import ChecksConfig
from pipeline.core.sections import SearchRange
from pipeline.rig.estimates import Check, PairEstimate, Prior, change_of
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.rig.targets import DEFAULT_TARGETS

PRIOR = Prior(np.eye(4), np.eye(4), np.radians(2), 0.05)
SIGMA = np.array([np.radians(0.1)] * 3 + [0.02] * 3)
SEARCH = SearchRange(np.radians(6), 0.3)
BETTER = HeldOutTest(1.0, 0.8, 0.02, 20, 10)
SAME = HeldOutTest(1.0, 0.99, 0.02, 20, 10)
WORSE = HeldOutTest(1.0, 1.1, 0.02, 20, 10)


def estimate(rotation_deg=0.0, shift_m=0.0, pair="camera_lidar", observable=None):
    T = from_rotation_translation(
        exp_so3(np.array([0, np.radians(rotation_deg), 0])), np.array([shift_m, 0, 0])
    )
    seen = np.ones(6, bool) if observable is None else np.array(observable, bool)
    return PairEstimate(pair, T, np.diag(SIGMA**2), np.where(seen, 0.9, 0.1), seen, 50)


SURE = {name: Claim(0.001, 0.0, 0.001, 0.001, np.radians(0.2), 0.995) for name in DIRECTIONS}


def verdict(result, test, failed=(), claims=SURE, limits=None, **changes):
    checks = [f if isinstance(f, Check) else Check(f) for f in failed]
    pair = result.pair
    of_edge = EdgeResult(
        pair, result.T, result.covariance, result.observable, PRIOR.of(pair), np.sqrt(np.diag(PRIOR.covariance(pair))),
        result.frames_used, SEARCH, DEFAULT_TARGETS,
    )  # fmt: skip
    return judge(of_edge, Evidence(test, claims, checks), limits or ChecksConfig(), **changes)


def checked(error, fault="witnesses_disagree"):
    return Check("two halves disagree", fault, error=None if error is None else change_of(map(float, error)))


DEG = np.radians(1.0)
YAWED = from_rotation_translation(exp_so3(np.array([0, 0, 0.02])), np.zeros(3))


@pytest.mark.parametrize(
    ("pair", "error", "status", "determined"),
    [
        ("camera_lidar", (0.0, 0.05 * DEG, 0.0, 0.0, 0.0, 0.0), "accepted", ("azimuth", "elevation")),
        ("camera_lidar", (0.0, 0.15 * DEG, 0.0, 0.0, 0.0, 0.0), "held", ()),
        ("camera_lidar", (0.0, 0.0, 0.0, 0.0, 0.1, 0.0), "held", ()),  # up to .4 deg of near targets
        ("lidar_radar", (0.0, 0.0, 0.15 * DEG, 0.0, 0.0, 0.0), "accepted", ("azimuth", "elevation")),
        ("lidar_radar", (0.0, 0.0, 0.5 * DEG, 0.0, 0.0, 0.0), "held", ()),
        ("lidar_radar", (0.0, 3 * DEG, 0.0, 0.0, 0.0, 0.0), "accepted", ("azimuth",)),  # its azimuth stands
        ("lidar_radar", (0.0, 0.0, 0.0, 0.4, 0.0, 0.0), "held", ()),  # along the line of sight
        ("lidar_lidar", (0.0, 3 * DEG, 0.0, 0.0, 0.0, 0.0), "accepted", ("azimuth",)),
        ("lidar_lidar", (0.0, 3 * DEG, 3 * DEG, 0.0, 0.0, 0.0), "held", ()),
    ],
)  # fmt: skip
def test_a_check_holds_where_the_pose_would_be_beyond_its_limits_if_it_is_right(
    pair, error, status, determined
):
    limits = {"camera_lidar": 0.2}.get(pair, 0.4)
    sure = {name: Claim(1e-4, 0.0, 1e-4, 1e-4, np.radians(limits), 0.995) for name in DIRECTIONS}
    prior = PairEstimate(pair, np.eye(4), np.diag(SIGMA**2), np.ones(6), np.ones(6, bool), 50)
    wide = np.full(6, 0.1)
    of_edge = EdgeResult(
        pair, prior.T, prior.covariance, prior.observable, np.eye(4), wide, 50, SEARCH, DEFAULT_TARGETS
    )
    found = judge(of_edge, Evidence(BETTER, sure, [checked(error)]), ChecksConfig())
    assert (found.status, found.determined) == (status, determined)
    assert found.faults == ("witnesses_disagree",)
    assert "two halves disagree" in found.reason
    assert not found.unsure_only


@pytest.mark.parametrize(
    ("off_deg", "sigma_deg", "status"),
    [(0.0, 0.12, "accepted"), (0.0, 0.16, "held"), (0.3, 0.01, "accepted"), (0.3, 0.05, "held"),
     (0.5, 0.01, "held"), (0.8, 11.5, "held")],
)  # fmt: skip
def test_what_a_check_leaves_possible_counts_its_size_and_its_own_sigma_against_the_limit(
    off_deg, sigma_deg, status
):
    """A radar's azimuth is wanted within .4 deg at 99.5 %: 2.8 sigmas of the check, 2.6 beside an offset."""
    claims = {name: Claim(1e-4, 0.0, 1e-4, 1e-4, 0.4 * DEG, 0.995) for name in DIRECTIONS}
    known_to = np.diag([*[(sigma_deg * DEG) ** 2] * 3, *[1e-6] * 3])
    check = Check(
        "another edge contradicts",
        error=change_of((0.0, 0.0, off_deg * DEG, 0.0, 0.0, 0.0)),
        covariance=known_to,
    )
    found = verdict(estimate(pair="lidar_radar"), BETTER, [check], claims)
    assert found.status == status
    known = off_deg > sigma_deg  # else no size is stated
    assert (f"{off_deg:.2f} +- {sigma_deg:.2f} deg at the targets" in found.reason) == known


def test_a_radars_tilt_in_doubt_certifies_no_elevation_however_little_targets_see_of_it():
    def tilted(deg, **known):
        check = replace(checked((deg * DEG, 0, 0, 0, 0, 0)), **known)
        claims = {name: Claim(1e-4, 0.0, 1e-4, 1e-4, 0.6 * DEG, 0.995) for name in DIRECTIONS}
        return verdict(estimate(0.2, pair="lidar_radar"), BETTER, [check], claims)

    for rolled in (tilted(0.5), tilted(1e-4, covariance=np.diag([(0.5 * DEG) ** 2, *[1e-8] * 5]))):
        assert (rolled.status, rolled.determined) == ("accepted", ("azimuth",))
        assert "two halves disagree" in rolled.reason
        assert "elevation not certified" in rolled.reason
    assert tilted(0.2).determined == DIRECTIONS


def test_a_check_whose_consequence_nobody_knows_always_holds():
    assert verdict(estimate(0.2), SAME, [checked(None)]).status == "held"
    assert verdict(estimate(0.2), SAME, [checked((0.0, 1e-5, 0.0, 0.0, 0.0, 0.0))]).status == "accepted"


def test_a_record_held_for_its_sigma_is_held_for_nothing_more_by_a_check_within_that_sigma():
    unsure = {name: claim(0.15) for name in DIRECTIONS}
    within = verdict(estimate(0.2), SAME, [checked((0.0, 0.1 * DEG, 0.0, 0.0, 0.0, 0.0))], unsure)
    assert (within.status, within.unsure_only) == ("held", True)
    beyond = verdict(estimate(0.2), SAME, [checked((0.0, 0.2 * DEG, 0.0, 0.0, 0.0, 0.0))], unsure)
    assert (beyond.status, beyond.unsure_only) == ("held", False)


SURER = np.diag((SIGMA / 20) ** 2)


@pytest.mark.parametrize("test", [SAME, WORSE])
def test_a_result_near_its_prior_is_held_where_held_out_frames_may_lead_beyond_the_prior(test):
    near = replace(estimate(0.03), covariance=SURER)
    assert verdict(near, test).status == "accepted"
    for lead in (claim(0.05, 0.08, 0.03), claim(0.06, 0.0, 0.02), claim(0.06, 0.0, 0.0)):
        assert verdict(near, test, claims=SURE | {"azimuth": lead}).status == "held"
    assert verdict(near, test, claims=SURE | {"azimuth": claim(0.05, 0.02, 0.04)}).status == "accepted"


@pytest.mark.parametrize(
    ("result", "test", "together", "status", "words"),
    [
        (estimate(0.3), WORSE, False, "held", "align worse than at the prior"),
        # Both are good for the purpose, whichever is right.
        (estimate(0.02), WORSE, False, "accepted", ""),
        (estimate(shift_m=0.1), WORSE, False, "held", "align worse"),  # .25 deg of targets 25 m away
        (estimate(shift_m=0.005), WORSE, False, "accepted", ""),
        (estimate(0.2), SAME, False, "accepted", ""),  # agrees with the prior
        (estimate(1.0), SAME, False, "held", "yaw moved by 10.0 of its sigmas"),
        (estimate(1.0, observable=[1, 0, 1, 1, 1, 1]), SAME, False, "accepted", "not determined by the day: yaw"),
        (estimate(0.0, observable=[0] * 6), SAME, False, "held", "no degree of freedom"),
        (replace(estimate(0.03), covariance=SURER), SAME, False, "accepted", ""),  # six sigmas that do not matter
        (replace(estimate(0.3), covariance=SURER), SAME, False, "held", "do not align better"),
        (estimate(1.0), None, False, "held", ""),
        (estimate(1.0), replace(BETTER, frames=2), False, "held", "too few held-out frames"),
        (estimate(11.0), BETTER, False, "held", "beyond the search range"),
        (estimate(8.5), BETTER, False, "held", "sigmas of the prior"),
        (estimate(0.5, 0.31), BETTER, False, "held", "beyond the search range"),
        # Where others have a say, two turns within the search range may add up to more than one range,
        (estimate(12.0, 0.4), BETTER, True, "accepted", ""),
        # and no better alignment is asked for, but no worse one; the prior may be better by chance.
        (estimate(1.0), SAME, True, "accepted", ""),
        (estimate(1.0), WORSE, True, "held", "align worse"),
        (estimate(0.2), WORSE, True, "accepted", ""),
        # A radar answers only for the moves that held-out frames score: of pitch they know nothing.
        (estimate(1.0, pair="lidar_radar"), SAME, False, "accepted", ""),
        (replace(estimate(pair="lidar_radar"), T=YAWED), SAME, False, "held", "yaw moved"),
    ],
)  # fmt: skip
def test_moves_are_accepted_by_how_far_they_lead_and_how_held_out_frames_align(
    result, test, together, status, words
):
    found = verdict(result, test, together=together)
    assert found.status == status
    assert words in found.reason
    assert (found.faults == ("prior",)) == (words in {"beyond the search range", "sigmas of the prior"})


def test_what_a_check_shows_to_be_wrong_is_told_from_what_is_only_unproved():
    assert verdict(estimate(0.3), WORSE).disproved
    assert verdict(estimate(shift_m=0.5), BETTER).disproved  # beyond the search range
    shown = Check("another basin is better", disproves=True)
    assert verdict(estimate(1.5), BETTER, failed=[shown]).disproved
    unproved = [
        verdict(estimate(1.0), SAME),
        verdict(estimate(1.5), BETTER, failed=["disjoint halves disagree"]),
        verdict(estimate(shift_m=0.15, pair="lidar_radar"), WORSE),  # its cost has slopes of its own
    ]
    assert [found.status for found in unproved] == ["held"] * 3
    assert not any(found.disproved for found in unproved)


def test_the_faults_that_failed_checks_name_reach_the_verdict_each_once():
    moved = Check("turned at noon", "moved_in_day")
    again = Check("turned back at two", "moved_in_day")
    found = verdict(estimate(1.5), BETTER, failed=[moved, Check("no name"), again])
    assert found.faults == ("moved_in_day",)
    assert verdict(estimate(1.5), BETTER).faults == ()


def claim(sigma_deg, shift_deg=0.0, shift_sigma_deg=0.1):
    sigma, shift, shift_sigma = np.radians([sigma_deg, shift_deg, shift_sigma_deg])
    return Claim(sigma, shift, shift_sigma, sigma, np.radians(0.2), 0.995)


def test_what_the_purpose_needs_more_exactly_than_it_is_known_is_held_but_for_a_radars_elevation():
    found = verdict(estimate(1.5), BETTER, claims=SURE | {"azimuth": claim(0.3)})
    assert found.status == "held"
    assert found.reason == "azimuth: its sigma of 0.30 deg is too large for the limit of 0.20 deg at 99.5 %"
    off = "held-out frames put it 0.15 deg off"
    for elevation, words in ((claim(0.5), "its sigma of 0.50 deg"), (claim(0.05, 0.15, 0.04), off)):
        claims = SURE | {"elevation": elevation}
        assert verdict(estimate(1.5), BETTER, claims=claims).status == "held"
        found = verdict(estimate(1.5, pair="lidar_radar"), BETTER, claims=claims)
        assert (found.status, found.determined) == ("accepted", ("azimuth",))
        assert f"elevation not certified: {words}" in found.reason


@pytest.mark.parametrize(("shift_deg", "status"), [(0.02, "accepted"), (0.15, "held")])
def test_a_shift_that_contradicts_by_its_sigmas_holds_where_it_matters_against_the_limit(shift_deg, status):
    """A real day was held for 0.02 deg at a sigma of 0.01, and was right."""
    off = SURE | {"elevation": claim(0.05, shift_deg, shift_sigma_deg=shift_deg / 3.5)}
    found = verdict(estimate(1.5), BETTER, claims=off)
    assert found.status == status
    assert not found.unsure_only
    assert ("elevation: held-out frames put it 0.15 deg off" in found.reason) == (status == "held")


def test_a_sigma_that_held_out_frames_exceed_is_not_only_too_large():
    wide = claim(0.1, 0.02, 0.005)  # by a tenth of its sigma
    assert verdict(estimate(1.5), BETTER, claims=SURE | {"elevation": wide}).unsure_only
    beyond = claim(0.1, 0.15, 0.04)
    assert not verdict(estimate(1.5), BETTER, claims=SURE | {"elevation": beyond}).unsure_only


def test_the_score_is_the_smallest_margin_and_ranks():
    scores = [
        verdict(estimate(1.5), BETTER, claims=SURE | {"azimuth": claim(s)}).score for s in (0.01, 0.04, 0.3)
    ]
    assert scores == sorted(scores, reverse=True)
    assert scores[1] > 0 > scores[2]
    assert verdict(estimate(1.5), BETTER, failed=["x"]).score < 0


def test_too_few_frames_are_refused():
    found = verdict(replace(estimate(1.0), frames_used=3), BETTER)
    assert (found.status, found.reason) == ("refused", "too few frames: 3, needs 8")
    why = verdict(replace(estimate(1.0), frames_used=0), BETTER, failed=["hardly any depth edges"]).reason
    assert why == "hardly any depth edges; too few frames: 0, needs 8"


def test_a_day_held_for_its_sigma_counts_in_the_state_and_one_that_is_too_short_to_judge_does_not():
    unsure = {name: claim(0.15) for name in DIRECTIONS}
    few = replace(estimate(0.2), frames_used=7)
    scenes = Check("too few scenes: its 7 frames show 2", "few_scenes")
    assert verdict(estimate(0.2), SAME, (), unsure).unsure_only
    for result, test, failed in (
        (few, SAME, ()),
        (few, None, (scenes,)),
        (estimate(1.0), replace(BETTER, frames=2), (scenes,)),
        (few, WORSE, ()),
        (few, SAME, (Check("another basin is better", disproves=True),)),
    ):
        found = verdict(result, test, failed, unsure)
        assert (found.status, found.unsure_only) == ("held", False)


@pytest.mark.parametrize(
    ("change", "turn_deg", "after", "words"),
    [
        ({"max_move_prior_sigmas": 0.5}, 1.5, 0.8, "sigmas of the prior"),
        ({"worse_alignment_z": 0.5}, 0.2, 1.02, "align worse"),
        ({"better_alignment_z": 3.0}, 1.5, 0.95, "do not align better"),
        ({"prior_agreement_sigmas": 1.0}, 0.2, 0.99, "do not align better"),
        ({"min_fit_frames": 51}, 1.5, 0.8, "needs 51"),
        ({"min_held_out_frames": 21}, 1.5, 0.8, "needs 21"),
    ],
)
def test_each_limit_of_the_verdict_decides(change, turn_deg, after, words):
    test = replace(BETTER, after=after)
    assert verdict(estimate(turn_deg), test).status == "accepted"
    strict = verdict(estimate(turn_deg), test, limits=ChecksConfig(**change))
    assert strict.status != "accepted"
    assert words in strict.reason


def test_paired_test_counts_blocks_not_frames():
    rng = np.random.default_rng(0)
    blocks = np.repeat(np.arange(10), 50)
    shared = np.repeat(rng.normal(size=10), 50)  # the same scene fifty times says it once
    found = paired_test(np.zeros(500), shared, blocks)
    assert found.standard_error == pytest.approx(shared[::50].std(ddof=1) / np.sqrt(10), rel=1e-6)


def test_a_scene_that_is_seen_for_long_outvotes_no_others():
    # Blocks of the real day: 11 of 12 scenes gain .1 to .4, a standing car's loses .2 in each of its 13 frames.
    gains = np.array([0.07, 0.17, 0.18, 0.27, -0.19, 0.09, 0.09, 0.16, 0.31, 0.12, 0.19, 0.40])
    frames = np.array([1, 2, 2, 1, 13, 1, 2, 1, 1, 1, 6, 9])
    blocks = np.repeat(np.arange(12), frames)
    found = paired_test(np.zeros(len(blocks)), -gains[blocks], blocks)
    assert found.after == pytest.approx(-gains.mean())
    assert found.z < -2.5
    assert found.z == pytest.approx(paired_test(np.zeros(12), -gains, np.arange(12)).z)


def test_paired_test_leaves_out_frames_without_both_costs():
    found = paired_test(np.array([1.0, np.nan, 2, 3]), np.array([0.0, 1, np.nan, 2]), np.arange(4))
    assert (found.before, found.after, found.frames) == (2.0, 1.0, 2)
    assert paired_test(np.full(3, np.nan), np.ones(3), np.arange(3)) is None


def test_two_blocks_are_no_proof_however_well_they_agree():
    before = np.zeros(8)
    blocks = np.repeat([0, 1], 4)
    after = np.repeat([1.0, 1.1], 4)
    found = paired_test(before, after, blocks)
    assert (after.mean() - 0) / found.standard_error > 15
    assert 1 < found.z < 2.5
