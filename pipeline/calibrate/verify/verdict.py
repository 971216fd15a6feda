"""Accept, hold or refuse: each check has a margin, the smallest is the score, and one below zero holds the record.

Accepted: the record certifies the directions listed in `determined` (azimuth, and elevation if the day
determines it, of targets 15 to 40 m away) within the stated limit. This applies to the image with this
CameraInfo, and to the mounting of the sensors for directions listed in `mounting`. Held: computed and
recorded, but a check failed and the prior stays current. Refused: not enough data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool

from pipeline.calibrate.reasons import because
from pipeline.calibrate.select.frames import SHORTEST
from pipeline.calibrate.verify.edge_result import RANGE, EdgeResult, at_targets, exceeded_by, tilt_in_doubt
from pipeline.calibrate.verify.held_out import HeldOutTest
from pipeline.calibrate.verify.target_accuracy import Claim
from pipeline.core.config import ChecksConfig
from pipeline.rig.estimates import Check, change_of, faults_of
from pipeline.rig.kinds import KIND_OF_EDGE
from schemas.words import AXIS_NAMES

__all__ = ["Evidence", "Verdict", "judge", "matters", "undetermined"]

_FAILED = Check.margin  # of a check that yields no number


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against the result of one edge."""

    held_out: HeldOutTest | None  # held-out frames at prior and result; None where none has both costs
    claims: Mapping[str, Claim]  # of azimuth and elevation at the targets
    failed_checks: Sequence[Check] = ()  # from the solver and from checks of the whole solution


@dataclass(frozen=True)
class Verdict:
    """Status of a record, the reason in words, the smallest margin, and which directions are certified."""

    status: str
    reason: str
    score: float = 0.0
    determined: tuple[str, ...] = field(default=())
    disproved: bool = False  # a check shows that the pose is wrong, not only unproved: nobody should use it
    unsure_only: bool = False  # held, but for nothing more than a sigma that is too large for the limits
    mounting: tuple[
        str, ...
    ] = ()  # of the certified directions, those in which the mounting is within the limit too
    # Keys of schemas.faults.FAULTS that failed checks name; of an accepted record those that do not matter.
    faults: tuple[str, ...] = ()

    @property
    def against(self) -> tuple[Check, ...]:
        """Why the adjustment of the rig must not use the edge; empty if it may, as with a sigma that is too large."""
        if self.status == "accepted" or (self.status == "held" and self.unsure_only):
            return ()
        fault = self.faults[0] if self.faults else ""
        return (Check(self.reason, fault, disproves=self.disproved),)


def judge(
    result: EdgeResult, evidence: Evidence, limits: ChecksConfig, *, triggered: bool = True,
    together: bool = False,
) -> Verdict:  # fmt: skip
    """Decide on one edge, of any kind.

    Args:
        result: the pose, its prior, and what was determined.
        evidence: held-out frames, claims and failed checks.
        limits: thresholds.
        triggered: False if no trigger is active for this edge, so that it was not estimated.
        together: whether other edges contribute to the pose. The move of the edge is then checked in its
            separate verdict, and it need not align better on its own held-out frames. But it must not align
            worse, and they must not contradict it.
    """
    if not triggered:
        return Verdict("held", because("not triggered"), _FAILED)
    faults = dict.fromkeys(faults_of(evidence.failed_checks))
    checks: list[Check] = []
    if result.frames_used < limits.min_fit_frames:
        few = because("few frames", used=result.frames_used, needed=limits.min_fit_frames)
        sentences = [check.sentence for check in evidence.failed_checks]
        if result.kind != "camera_lidar" or result.frames_used < SHORTEST:
            return Verdict("refused", "; ".join([*sentences, few]), _FAILED, faults=tuple(faults))
        checks.append(Check(few))
    checks += [
        replace(check, sentence=_with_size(check, result, because("beyond")))
        for check in evidence.failed_checks
        if matters(check, result, evidence.claims)
    ]
    if together:
        checks += _aligns_no_worse(result, evidence.claims, evidence.held_out, limits)
    else:
        checks += _moves_little(result, limits)
        if KIND_OF_EDGE[result.kind].scored:
            checks.append(_aligns_better(result, evidence.claims, evidence.held_out, limits))
    checks += _claims_hold(result, evidence.claims)
    if not result.observable.any():
        checks.append(Check(because("nothing")))
    score = min(1.0, *(c.margin for c in checks))
    failed = [c for c in checks if c.margin < 0]
    return _held(failed, score, faults) if failed else _accepted(result, evidence, score)


def _held(failed: Sequence[Check], score: float, faults: Mapping[str, None]) -> Verdict:
    """The verdict with failed checks; `faults` are named besides theirs."""
    return Verdict(
        "held",
        "; ".join(c.sentence for c in failed),
        score,
        disproved=any(c.disproves for c in failed),
        unsure_only=all(c.of_sigma for c in failed),
        faults=tuple(dict.fromkeys([*faults, *(c.fault for c in failed if c.fault)])),
    )


def matters(check: Check, result: EdgeResult, claims: Mapping[str, Claim]) -> bool:
    """Whether the pose would be no good for what the edge is needed for if the check is right."""
    exceeded, needed = set(_exceeded(check, result, claims)), KIND_OF_EDGE[result.kind].required
    if needed is None:
        return RANGE in exceeded or exceeded >= claims.keys()
    return not exceeded.isdisjoint({*needed, RANGE})


def _accepted(result: EdgeResult, evidence: Evidence, score: float) -> Verdict:
    """The verdict without a failed check that matters, with what it certifies."""
    claims, checks = evidence.claims, evidence.failed_checks
    doubted = {name for check in checks for name in _exceeded(check, result, claims)}
    certified = tuple(name for name, claim in claims.items() if claim.margin >= 0 and name not in doubted)
    said = [_harmless(check, result, claims) for check in checks]
    reason = "; ".join([*said, *_reservations(result, claims)])
    faults = tuple(faults_of(checks))
    mounting = tuple(name for name in certified if claims[name].certifies_mounting)
    return Verdict("accepted", reason, score, certified, mounting=mounting, faults=faults)


def _exceeded(check: Check, result: EdgeResult, claims: Mapping[str, Claim]) -> list[str]:
    """Directions whose limit the pose exceeds if the check is right; no radar's elevation with a tilt in doubt."""
    tilted = ["elevation"] if tilt_in_doubt(result, check) is not None else []
    return list(dict.fromkeys([*exceeded_by(result, claims, check), *tilted]))


def _harmless(check: Check, result: EdgeResult, claims: Mapping[str, Claim]) -> str:
    """Sentence about a check that does not hold the record."""
    if exceeded := _exceeded(check, result, claims):
        return because("not certified", reason=check.sentence, directions=" and ".join(exceeded))
    return _with_size(check, result, because("within"))


def _with_size(check: Check, result: EdgeResult, limit: str) -> str:
    """The check's sentence with the largest error that it shows at the targets and knows to less than its size."""
    if check.error is None or not any(check.error):
        return check.sentence
    known = [(off, sigma) for off, sigma in at_targets(result, check).values() if off > (sigma or 0.0)]
    if not known:
        return f"{check.sentence}: {limit}"
    off_rad, known_to_rad = max(known, key=lambda found: found[0])
    sigma = "" if known_to_rad is None else f" +- {np.degrees(known_to_rad):.2f}"
    return because("sized", reason=check.sentence, size=f"{np.degrees(off_rad):.2f}{sigma}", limit=limit)


def _moves_little(result: EdgeResult, limits: ChecksConfig) -> list[Check]:
    """Within the search range, and within the prior's sigmas."""
    step, search = result.move, result.search
    rotation, translation = float(np.linalg.norm(step[:3])), float(np.abs(step[3:]).max())
    # The searched box has half-widths per axis: its corners lie sqrt(3) further out.
    reach = np.sqrt(3) * search.rotation_rad
    ratio = np.abs(step) / result.prior_sigma
    worst = int(np.argmax(ratio))
    shifted, moved = translation / search.translation_m, float(ratio[worst] / limits.max_move_prior_sigmas)
    axis = because("far", axis=result.names[worst], ratio=ratio[worst])
    return [
        Check(
            because("far turn", off=np.degrees(rotation)),
            "prior",
            margin=1 - rotation / reach,
            disproves=True,
        ),
        Check(because("far shift", off=translation), "prior", margin=1 - shifted, disproves=True),
        Check(axis, "prior", margin=1 - moved),
    ]


def _aligns_better(
    result: EdgeResult, claims: Mapping[str, Claim], test: HeldOutTest | None, limits: ChecksConfig
) -> Check:
    """Held-out frames align better than at the prior, or as well if the result hardly differs from the prior."""
    if test is None or test.frames < limits.min_held_out_frames:
        found = 0 if test is None else test.frames
        return Check(because("few held out", used=found, needed=limits.min_held_out_frames))
    near = _near_prior(result, claims)
    if test.z > limits.worse_alignment_z:
        # The radar's registration cost has slopes of its own (`lidar_radar/search`): a right result near a prior
        # may score worse. That leaves it unproved, no more.
        is_proof = result.kind == "camera_lidar"
        margin = max(near, 1 - test.z / limits.worse_alignment_z)
        return Check(_worse(test), margin=margin, disproves=is_proof)
    name, ratio = _largest_move(result)
    same = 1 - ratio / limits.prior_agreement_sigmas
    better = (-test.z - limits.better_alignment_z) / limits.better_alignment_z
    sentence = because("not better", axis=name, ratio=ratio, z=test.z)
    return Check(sentence, margin=min(1.0, max(same, better, near)))


def _aligns_no_worse(
    result: EdgeResult, claims: Mapping[str, Claim], test: HeldOutTest | None, limits: ChecksConfig
) -> list[Check]:
    """If other pairs contribute to the pose: alignment no worse than at a prior that the result contradicts."""
    if test is None:
        return []
    _, ratio = _largest_move(result)
    same, not_worse = 1 - ratio / limits.prior_agreement_sigmas, 1 - test.z / limits.worse_alignment_z
    margin = min(1.0, max(same, not_worse, _near_prior(result, claims)))
    return [Check(_worse(test), margin=margin)]


def _near_prior(result: EdgeResult, claims: Mapping[str, Claim]) -> float:
    """0 where the result is good for its purpose whatever its alignment says of it, else -1.

    It is good if the prior is right in what held-out frames score, and held-out frames, which may lead beyond the
    prior, would move it by no more either.
    """
    back = change_of(np.where(KIND_OF_EDGE[result.kind].is_scored, -result.move, 0.0))
    if exceeded_by(result, claims, Check(because("prior right"), error=back)):
        return _FAILED
    needed = KIND_OF_EDGE[result.kind].required or tuple(claims)
    return 0.0 if all(claims[name].agrees_with_held_out for name in needed) else _FAILED


def _largest_move(result: EdgeResult) -> tuple[str, float]:
    """Largest move of a degree of freedom that held-out frames score, in sigmas of the result."""
    ratio = np.where(KIND_OF_EDGE[result.kind].is_scored, result.move_sigmas, 0.0)
    worst = int(np.argmax(ratio))
    return result.names[worst], float(ratio[worst])


def _worse(test: HeldOutTest) -> str:
    return because("worse", after=test.after, before=test.before, z=test.z)


def _claims_hold(result: EdgeResult, claims: Mapping[str, Claim]) -> list[Check]:
    """What the purpose needs must be within its limit, by its sigma and by what held-out frames contradict.

    A sigma that held-out frames exceed is not only too large: the pose may lie outside of it.
    """
    needed = KIND_OF_EDGE[result.kind].required
    checks = {
        name: Check(
            because("claim", direction=name, reason=claim.reason),
            margin=claim.margin,
            of_sigma=not claim.is_exceeded,
        )
        for name, claim in claims.items()
    }
    if needed is not None:
        return [checks[name] for name in needed if name in checks]
    # Either direction will do, but none that the rest of the day contradicts.
    wrong = [
        replace(c, fault="witnesses_disagree") for c in checks.values() if c.margin < 0 and not c.of_sigma
    ]
    best = max(check.margin for check in checks.values())
    return [*wrong, *(c for c in checks.values() if c.of_sigma and (best < 0 or c.margin == best))]


def _reservations(result: EdgeResult, claims: Mapping[str, Claim]) -> list[str]:
    """Axes that an accepted record does not certify."""
    open_claims = [
        because("uncertified", direction=name, reason=claim.reason)
        for name, claim in claims.items()
        if claim.margin < 0
    ]
    return [*open_claims, *undetermined(result.kind, result.observable)]


def undetermined(kind: str, observable: Bool[np.ndarray, " 6"]) -> list[str]:
    """A sentence on the degrees of freedom that the day did not determine; none if there are none."""
    axes = AXIS_NAMES[kind.partition("_")[0]]
    names = ", ".join(axis for axis, seen in zip(axes, observable, strict=True) if not seen)
    return [because("undetermined", axes=names)] if names else []
