"""A quick run of the benchmark of causes: the right one is named, and none where nothing is wrong."""

import numpy as np
import pytest

from benchmarks.decisions import CAUSES, diagnosed


@pytest.mark.parametrize("cause", CAUSES, ids=" ".join)
def test_a_cause_at_twice_the_size_that_its_test_needs_is_the_one_named(cause):
    row = diagnosed(cause, 20, seed=1)
    assert row.named >= 19  # 18 or fewer of 20 would happen in 2 of 100 runs at 98.8 of 100
    # Its value is off by its sigma: 20 draws, 99 %.
    assert 0.6 < row.w_rms < 1.5


def test_without_a_cause_none_is_named():
    row = diagnosed(None, 40, seed=1)
    assert row.named >= 36 and np.isnan(row.median_size)
