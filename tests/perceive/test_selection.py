"""Selection agrees with sorting, also where many values are equal."""

import numpy as np
import pytest

from pipeline.perceive.ground import kth_smallest, median_of


@pytest.mark.parametrize("kinds", [3, 1000])
@pytest.mark.parametrize("count", [1, 2, 7, 40])
def test_the_kth_smallest_and_the_median_are_those_of_sorted_values(count, kinds):
    rng = np.random.default_rng([count, kinds])
    for _ in range(20):
        value = rng.integers(0, kinds, 50).astype(np.float64)
        for k in range(count):
            assert kth_smallest(value.copy(), count, k) == np.sort(value[:count])[k]
        assert median_of(value.copy(), count) == np.median(value[:count])
