"""Codes of faults: each has a sentence of its own, by which readers of reasons find the code again."""

import re
from itertools import permutations

from pipeline.report.words import ANSWERS
from schemas.calibrations import STATUSES
from schemas.drift import DRIFT_STATUSES
from schemas.faults import FAULTS, in_words
from schemas.outcomes import OUTCOME_STATUSES
from schemas.words import DAY_WORDS, NEXT_STEPS, RECORD_WORDS, day_word
from tests.sentences import sentences


def test_each_code_has_a_sentence_that_begins_no_other():
    assert all(code.replace("_", "").isalpha() for code in FAULTS)
    assert all(sentence.strip() for sentence in FAULTS.values())
    assert not any(a.startswith(b) for a, b in permutations(FAULTS.values(), 2))
    assert in_words(FAULTS) == "; ".join(FAULTS.values())
    assert in_words(["unit", "gone"]) == f"{FAULTS['unit']}; gone"


RETIRED = re.compile(
    r"\b(witness\w*|told|tells?|sa(ys?|id)|knows?|believ\w*|opinions?|vouch\w*|so many|way)\b"
)


def test_every_status_has_a_sentence():
    of_days = {day_word(pairs) for pairs in ([], *([status] for status in STATUSES))}
    assert {*of_days, *OUTCOME_STATUSES} <= set(DAY_WORDS)
    assert set(RECORD_WORDS) == set(STATUSES)
    assert {step.partition(",")[0] for step in NEXT_STEPS} == {*DRIFT_STATUSES} - {"GREEN"}
    assert {*DRIFT_STATUSES, "right", "wrong", "inconclusive"} <= set(ANSWERS)


def test_every_sentence_passes_at_first_reading():
    assert [(place, s) for place, s in sentences() if RETIRED.search(s) or len(s.split()) > 25] == []
