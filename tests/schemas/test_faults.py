"""Codes of faults: each has a sentence of its own, by which readers of reasons find the code again."""

import re
from itertools import permutations

from jobs.cli import COMMANDS
from pipeline.report.day import _ADVICE
from pipeline.report.words import LEFT_OUT
from schemas.calibrations import STATUSES
from schemas.drift import DRIFT_STATUSES, DriftFinding, next_step
from schemas.faults import FAULTS, in_words
from schemas.outcomes import OUTCOME_STATUSES
from schemas.words import DAY_WORDS, day_word


def test_each_code_has_a_sentence_that_begins_no_other():
    assert all(code.replace("_", "").isalpha() for code in FAULTS)
    assert all(sentence.strip() for sentence in FAULTS.values())
    assert not any(a.startswith(b) for a, b in permutations(FAULTS.values(), 2))


def test_codes_are_told_in_their_sentences_and_an_unknown_one_as_it_is():
    assert in_words(FAULTS) == "; ".join(FAULTS.values())
    assert in_words(["unit", "gone"]) == f"{FAULTS['unit']}; gone"


RETIRED = re.compile(r"\b(witness\w*|told|tells?|says?|said|knows?|opinions?|vouch\w*|so many|nothing but)\b")


def test_every_status_and_command_has_a_sentence_that_passes_at_first_reading():
    of_days = {day_word(pairs) for pairs in ([], *([status] for status in STATUSES))}
    assert {*of_days, *OUTCOME_STATUSES} <= set(DAY_WORDS)
    assert set(_ADVICE) == set(STATUSES)
    row = {"vehicle": "v", "day": "2026-03-09", "method": "joint", "pair": "camera_lidar", "dof": "rx"}
    steps = []
    for status in DRIFT_STATUSES:
        of = row | {
            "parent_frame": "camera",
            "child_frame": "lidar",
            "status": status,
            "reason": "",
            "limit": 0.1,
        }
        finding = DriftFinding(
            **of, vehicle_status=status, vehicle_reason="", days_used=4, vehicle_days_needed=2
        )
        steps.append(next_step([finding], "L"))
        assert bool(steps[-1]) == (status != "GREEN")
    helped = [text for _, text in COMMANDS.values()]
    for sentence in [
        *FAULTS.values(),
        *DAY_WORDS.values(),
        *_ADVICE.values(),
        *LEFT_OUT.values(),
        *helped,
        *steps,
    ]:
        assert not RETIRED.search(sentence), sentence
        assert all(len(part.split()) <= 25 for part in re.split(r"[.;:`]", sentence)), sentence
