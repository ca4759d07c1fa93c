"""Covariances against closed forms, Monte Carlo and published NEES bands."""

import numpy as np
import pytest

from pipeline.geometry import gaussian, se3, so3


def random_covariance(n, rng, scale=1.0):
    A = scale * rng.normal(size=(n, n))
    return A @ A.T


def test_upper_triangle_runs_row_by_row_and_comes_back():
    names = np.array([[10.0 * min(i, j) + max(i, j) for j in range(6)] for i in range(6)])
    triangle = gaussian.upper_triangle(names)
    expected = [10 * i + j for i in range(6) for j in range(i, 6)]
    assert triangle.shape == (21,)
    assert triangle.tolist() == expected
    batch = np.stack([names, 2 * names])[None]
    assert np.array_equal(gaussian.from_upper_triangle(gaussian.upper_triangle(batch)), batch)


def test_a_tool_point_on_a_lever_moves_by_the_lever_times_the_angle():
    # 1 mrad about z at the end of a lever of 4 m along x: 4 mm sideways and nothing else.
    cov_xi = np.diag([0, 0, 0, 0, 0, 1e-6])
    cov = gaussian.tool_point_covariance(np.eye(4), cov_xi, np.array([4.0, 0.0, 0.0]))
    assert np.allclose(np.sqrt(np.diag(cov)), [0, 0.004, 0], rtol=0, atol=1e-15)


def test_tool_point_covariance_predicts_the_scatter_of_perturbed_poses():
    rng = np.random.default_rng(2)
    T_world_body = se3.exp(np.array([50.0, 20.0, -3.0, 1.0, 0.5, -0.8]))
    p_body = np.array([1.2, -0.4, 3.1])
    cov_xi = random_covariance(6, rng, 0.002)
    xi = rng.multivariate_normal(np.zeros(6), cov_xi, size=40_000)
    scatter = np.cov(se3.transform(se3.retract(T_world_body, xi), p_body).T)
    cov = gaussian.tool_point_covariance(T_world_body, cov_xi, p_body)
    sigma = np.sqrt(np.diag(cov))
    # A sampled correlation is good to 1 / sqrt(40,000) = 0.005, a variance to 0.007.
    assert np.allclose(scatter / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=0.03)


def test_tool_point_jacobian_matches_central_differences():
    T_world_body = se3.exp(np.array([[5.0, 2.0, -3.0, 1.0, 0.5, -0.8], [1.0, 0.0, 0.0, 0.0, 2.0, 0.1]]))
    p_body = np.array([1.2, -0.4, 3.1])
    step = 1e-6
    columns = []
    for d in step * np.eye(6):
        ahead, behind = (se3.transform(se3.retract(T_world_body, s * d), p_body) for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    J_p_xi = gaussian.tool_point_jacobian(T_world_body, p_body)
    assert np.allclose(J_p_xi, np.stack(columns, axis=-1), rtol=0, atol=1e-8)


def test_a_quarter_turn_exchanges_the_variances():
    R_world_body = so3.from_rpy_deg([0.0, 0.0, 90.0])  # body x points along world y
    turned = gaussian.rotate_covariance(R_world_body, np.diag([1.0, 4.0, 9.0]))
    assert np.allclose(turned, np.diag([4.0, 1.0, 9.0]), atol=1e-15)


def test_nees_counts_sigmas_and_averages_to_the_dimension():
    assert gaussian.nees(np.array([2.0, 0.0]), np.diag([4.0, 1.0])) == pytest.approx(1.0)
    rng = np.random.default_rng(7)
    cov = random_covariance(6, rng)
    errors = rng.multivariate_normal(np.zeros(6), cov, size=5_000)
    low, high = gaussian.nees_band(6, 5_000, level=0.999)
    assert low < gaussian.nees(errors, cov).mean() < high
    # The error that matters: an estimate that claims half of its sigma must fall out of the band.
    assert gaussian.nees(errors, 0.25 * cov).mean() > high


@pytest.mark.parametrize("n, low, high", [(3, 2.67, 3.35), (6, 5.53, 6.49)])
def test_nees_band_of_200_runs_at_95_percent(n, low, high):
    assert gaussian.nees_band(n, 200) == (pytest.approx(low, abs=0.005), pytest.approx(high, abs=0.005))


def test_a_wider_level_gives_a_wider_band():
    narrow, wide = gaussian.nees_band(6, 50, level=0.9), gaussian.nees_band(6, 50, level=0.99)
    assert wide[0] < narrow[0] < 6 < narrow[1] < wide[1]


def test_is_covariance_tells_why_not_one_by_one():
    good = random_covariance(6, np.random.default_rng(1))
    units = np.diag([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6])
    asymmetric = good.copy()
    asymmetric[0, 1] += 1e-3 * good[0, 0]
    indefinite = np.eye(6)
    indefinite[0, 1] = indefinite[1, 0] = 1.1
    negative = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3])
    holed = good.copy()
    holed[2, 2] = np.nan
    # Indefinite in the small unit only: an eigenvalue of the raw matrix would be -1e-13, "zero".
    hidden = units @ indefinite[::-1, ::-1] @ units
    singular = np.diag([1.0, 1.0, 1.0, 0.0, 1.0, 1.0])
    cases = np.stack([good, units @ good @ units, singular, asymmetric, indefinite, negative, holed, hidden])
    assert gaussian.is_covariance(cases).tolist() == [True, True, True] + [False] * 5


def test_nothing_may_covary_with_what_is_held_fixed():
    cov = np.diag([1.0, 0.0])
    cov[0, 1] = cov[1, 0] = 0.1
    assert not gaussian.is_covariance(cov)
