"""The bound of a distance against scipy's noncentral distributions and against drawn errors."""

import numpy as np
import pytest
from scipy import stats

from pipeline.surface.distance_bound import lower_bound, quantiles


def bound(distance, sigma, sideways):
    return lower_bound(float(distance), float(sigma), float(sideways), quantiles())


@pytest.mark.parametrize("true", [0.0, 0.3, 1.0, 2.5, 6.0, 15.0, 80.0])
def test_with_one_sigma_all_round_it_is_the_noncentral_chi_of_two_dimensions(true):
    estimate = np.sqrt(stats.ncx2.ppf(0.95, 2, max(true, 1e-12) ** 2))
    # Straight lines between tabled distances: rather too small, by 0.004 sigma at most.
    assert true - 0.02 <= bound(1e-9 + 0.05 * estimate, 0.05, 0.05) / 0.05 <= true + 1e-3


@pytest.mark.parametrize("true", [0.0, 0.5, 2.0, 9.0])
def test_without_error_sideways_it_is_the_folded_normal(true):
    estimate = stats.foldnorm.ppf(0.95, true)
    assert bound(estimate + 1e-9, 1.0, 0.0) == pytest.approx(true, abs=0.01)


def test_far_away_it_is_1645_sigmas_and_without_any_error_the_distance():
    assert bound(40.0, 0.1, 0.1) == pytest.approx(40 - 0.1645, abs=2e-4)
    assert bound(0.7, 0.0, 0.0) == 0.7
    assert bound(0.0, 0.1, 0.3) == 0.0


def test_it_grows_with_the_distance_and_falls_with_either_sigma():
    d = np.linspace(0, 4, 400)
    for sideways in (0.0, 0.05, 0.13, 0.6, 3.0):
        values = np.array([bound(x, 0.1, sideways) for x in d])
        assert np.all(np.diff(values) >= 0) and np.all(values <= d)
    for x in (0.2, 0.5, 2.0):
        assert np.all(np.diff([bound(x, 0.1, s) for s in np.linspace(0, 2, 100)]) <= 1e-12)
        assert np.all(np.diff([bound(x, s, 0.1) for s in np.linspace(0.02, 2, 100)]) <= 1e-12)


@pytest.mark.parametrize("ratio", [0.4, 1.0, 2.0, 4.0, 9.0])
@pytest.mark.parametrize("true", [0.0, 0.8, 2.0, 5.0])
def test_95_of_100_drawn_bounds_hold_whatever_the_errors_sideways(ratio, true):
    rng = np.random.default_rng(5)
    sigma, n = 0.03, 20_000
    estimate = np.hypot(true * sigma + rng.normal(0, sigma, n), rng.normal(0, ratio * sigma, n))
    held = np.mean([bound(x, sigma, ratio * sigma) <= true * sigma + 1e-12 for x in estimate])
    # Three standard errors of 20,000 draws are 0.005. Beyond a ratio of 5 the bound is on the safe side.
    assert held >= 0.945
    if 1.0 <= ratio <= 4.0 and true > 0:
        assert held <= 0.957


def test_1645_sigmas_alone_would_exclude_one_true_hit_in_four():
    """What this module is for: a cable of no radius that the edge did cut, its place known to 100 mm."""
    rng = np.random.default_rng(6)
    estimate = np.linalg.norm(rng.normal(0, 0.1, (20_000, 2)), axis=1)
    assert np.mean(estimate - 1.645 * 0.1 > 0) == pytest.approx(0.26, abs=0.01)
    assert np.mean([bound(x, 0.1, 0.1) > 0 for x in estimate]) == pytest.approx(0.05, abs=0.005)
