"""Codes of faults: each has a sentence of its own, by which readers of reasons find the code again."""

from itertools import permutations

from schemas.faults import FAULTS, in_words


def test_each_code_has_a_sentence_that_begins_no_other():
    assert all(code.replace("_", "").isalpha() for code in FAULTS)
    assert all(sentence.strip() for sentence in FAULTS.values())
    assert not any(a.startswith(b) for a, b in permutations(FAULTS.values(), 2))


def test_codes_are_told_in_their_sentences_and_an_unknown_one_as_it_is():
    assert in_words(FAULTS) == "; ".join(FAULTS.values())
    assert in_words(["unit", "gone"]) == f"{FAULTS['unit']}; gone"
