import numpy as np
import pytest

from benchmarks.corner_noise import measure
from pipeline.config.quantities import FAMILIES
from pipeline.detection.noise import corner_covariance, edge_sigma
from pipeline.detection.prints import cells_across


@pytest.mark.parametrize(
    "side_px, tilts_deg", [(20, (0, 45)), (40, (0, 45, 60)), (80, (0, 60)), (160, (45,))]
)
def test_normalised_corner_errors_are_near_one(side_px, tilts_deg):
    """Bars as in the benchmark, which takes more trials and the whole grid; the seeds are others."""
    for tilt_deg in tilts_deg:
        cell = measure("tag36h11", side_px, tilt_deg, trials=25, seed=100 + side_px + tilt_deg)
        assert cell.found >= 24
        assert 0.75 < cell.normalised < 1.3


def test_a_frontal_square_has_the_covariance_of_two_independent_edges():
    square = np.array([[[0, 0], [100, 0], [100, 100], [0, 100.0]]])
    sigma = edge_sigma(100 / 8, 100.0, 0.0)
    assert np.allclose(corner_covariance(square, 8), sigma**2 * np.eye(2))


def test_an_acute_corner_is_least_certain_along_its_bisector():
    """Edges that nearly share a direction fix their meeting point badly along it."""
    kite = np.array([[[0, 0], [100, -30], [200, 0], [100, 30.0]]])
    cov = corner_covariance(kite, 8)[0, 0]
    assert cov[0, 0] > 5 * cov[1, 1]
    assert abs(cov[0, 1]) < 1e-9 * cov[0, 0]


@pytest.mark.parametrize("family", FAMILIES)
def test_sigma_falls_with_size_to_a_floor(family):
    sides = np.array([10, 16, 20, 25, 30, 40, 60, 80, 160, 640.0])
    quads = sides[:, None, None] * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    sigma = np.sqrt(corner_covariance(quads, cells_across(family))[:, 0, 0, 0])
    assert np.all(np.diff(sigma) <= 0)
    assert 0.015 < sigma[-1] < 0.03
    assert sigma[0] > 0.1


def test_what_is_hardly_a_quad_gets_a_wide_finite_covariance():
    flat = np.array([[[0, 0], [10, 0], [20, 0.1], [10, 0.1]], [[0, 0], [0, 0], [0, 0], [0, 0]]], float)
    cov = corner_covariance(flat, 8)
    assert np.all(np.isfinite(cov))
    assert np.all(np.linalg.eigvalsh(cov)[..., 0] > 0)
