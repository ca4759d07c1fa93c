"""Covariances that are true: errors of adjustments of drawn networks are as large as they say."""

import numpy as np
import pytest

from tests.estimation.monte_carlo import band, nees, sample, small

RUNS = 100


@pytest.mark.parametrize(
    "bucket_marker",
    [pytest.param(False, id="potentiometer"), pytest.param(True, id="bucket marker", marks=pytest.mark.slow)],
)
def test_errors_of_a_hundred_drawn_networks_are_as_large_as_their_covariances_say(bucket_marker):
    found = sample(RUNS, small(bucket_marker))
    low, high = band(RUNS, 3)
    assert low < nees(found.edge) < high
    low, high = band(RUNS, 6)
    assert low < nees(found.pose) < high
    low, high = band(RUNS, 1)
    assert low < nees(found.elevation) < high
    assert np.mean(np.abs(found.elevation) < 1.96) >= 0.89  # 95 %, less 2.75 sigma of a hundred draws
    assert np.mean(found.statics**2) == pytest.approx(1, abs=0.1)


def test_covariances_that_take_the_files_as_exact_are_far_too_small():
    found = sample(20, small(), trust_files=True)
    assert nees(found.edge) > 10 * band(20, 3)[1]
