"""Shape checks by sample find what checks of every call find, in the calls that they look at."""

import dataclasses

import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError

from tests.shapes import FIRST_CALLS, THEN_ONE_IN, jaxtyped

checked = jaxtyped(typechecker=beartype)


@checked
def total(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"]) -> float:
    return float(values @ weights) if len(values) == len(weights) else 0.0


@checked
@dataclasses.dataclass
class Pair:
    left: Float[np.ndarray, " n"]
    right: Float[np.ndarray, " n"]

    @staticmethod
    @checked
    def count(values: Float[np.ndarray, " n"]) -> int:
        return values.size  # type: ignore[no-any-return]


def test_the_first_call_with_a_wrong_shape_or_type_fails():
    with pytest.raises(TypeCheckError, match="total"):
        total(np.ones(3), np.ones(4))
    with pytest.raises(TypeCheckError, match="Pair"):
        Pair(np.ones(3), np.ones(4))
    with pytest.raises(TypeCheckError, match="count"):
        Pair.count(np.ones((2, 2)))


def test_a_wrong_call_in_the_middle_of_many_right_ones_is_found_at_its_turn():
    @checked
    def first_of(values: Float[np.ndarray, " n"]) -> float:
        return float(values.flat[0])

    found = 0
    for call in range(1, FIRST_CALLS + 3 * THEN_ONE_IN + 1):
        values = np.ones((1, 1) if call > FIRST_CALLS else 1)
        try:
            first_of(values)
        except TypeCheckError:
            found += 1
    assert found == 3
