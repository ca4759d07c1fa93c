"""Millimetres at the working distance: closed forms, and scatter of drawn intrinsics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.calibration import placing as module
from pipeline.calibration.placing import difference, places_over, placing
from pipeline.geometry.lenses import BROWN5, FISHEYE

SIZE = (641, 481)
PINHOLE = np.array([600.0, 600.0, 320.0, 240.0, 0, 0, 0, 0, 0])


def only(sigma, *at):
    cov = np.zeros((9, 9))
    for i in at:
        for j in at:
            cov[i, j] = sigma**2
    return cov


def test_focal_length_is_distance():
    found = placing(BROWN5, PINHOLE, only(0.6, 0, 1), SIZE, 10.0)
    row, column = (np.array(found.uv.shape[:2]) - 1) // 2
    assert np.allclose(found.uv[row, column], [320, 240])
    # 0.1 % of the focal length, on the axis: 10 mm of 10 m, and nothing across.
    assert found.along_m[row, column] == pytest.approx(0.010, rel=2e-3)
    assert found.across_m[row, column] < 1e-5
    assert placing(BROWN5, PINHOLE, only(0.6, 0, 1), SIZE, 5.0).total_m == pytest.approx(
        found.total_m / 2, rel=1e-6
    )


def test_a_shift_of_the_centre_is_mostly_a_turn_of_the_camera():
    # 1 px is 1.67 mrad, 17 mm at 10 m; the turn that takes it up leaves the second order.
    found = placing(BROWN5, PINHOLE, only(1.0, 2), SIZE, 10.0)
    assert found.across_m.max() < 0.25 * 0.0167


def test_sigmas_are_the_scatter_of_drawn_intrinsics():
    """Tags seen with each of 300 drawn lenses; the common turn by SciPy's Kabsch."""
    k = np.array([600.0, 603, 318, 243, -0.2, 0.05, 0.001, -0.0005, 0.01])
    sigma = np.array([0.3, 0.3, 0.5, 0.5, 0.002, 0.006, 1e-4, 1e-4, 0.005])
    found = placing(BROWN5, k, np.diag(sigma**2), SIZE, 10.0)
    rng = np.random.default_rng(8)
    uv = places_over(SIZE).reshape(-1, 2)
    d, _ = BROWN5.directions(uv, k)
    corners = BROWN5.project(module._facing(d, 10.0), k)
    drawn = []
    for _ in range(300):
        seen = module._seen_with(BROWN5, k + sigma * rng.normal(size=9), corners, d, 10.0)
        turn, _ = Rotation.align_vectors(d, seen)
        drawn.append(turn.apply(seen) - 10.0 * d)
    drawn = np.array(drawn)
    along = np.einsum("sgi,gi->sg", drawn, d)
    across = np.sqrt((np.sum(drawn**2, axis=2) - along**2).mean(axis=0) / 2)
    assert np.allclose(np.sqrt(np.mean(along**2, axis=0)), found.along_m.ravel(), rtol=0.2)
    assert np.sqrt(np.mean(across**2)) == pytest.approx(np.sqrt(np.mean(found.across_m**2)), rel=0.1)


@pytest.mark.parametrize("lens", [BROWN5, FISHEYE], ids=lambda lens: lens.name)
def test_halves_that_differ_by_chance_fit_and_others_do_not(lens):
    k = {9: np.array([600.0, 603, 318, 243, -0.2, 0.05, 0.001, -0.0005, 0.01]),
         8: np.array([400.0, 401, 318, 243, 0.03, -0.01, 0.002, -0.0004])}[len(lens)]  # fmt: skip
    rng = np.random.default_rng(9)
    sigma = np.concatenate([[0.2, 0.2, 0.3, 0.3], np.full(len(lens) - 4, 0.0003)])
    L = np.diag(sigma) @ np.linalg.cholesky(0.6 * np.ones((len(lens),) * 2) + 0.4 * np.eye(len(lens)))
    cov = L @ L.T
    found = [
        difference(
            lens, (k + L @ rng.normal(size=len(k)), cov), (k + L @ rng.normal(size=len(k)), cov), SIZE, 10.0
        )
        for _ in range(60)
    ]
    assert sum(not one.fits for one in found) <= 1
    assert np.sqrt(np.mean([one.ratio**2 for one in found])) == pytest.approx(1.0, abs=0.25)
    off = k.copy()
    off[:2] *= 1.01
    far = difference(lens, (k, cov), (off, cov), SIZE, 10.0)
    assert not far.fits
    row, column = (np.array(far.uv.shape[:2]) - 1) // 2
    # 1 % of the focal length: 0.1 m of 10 m.
    assert far.found_m[row, column] == pytest.approx(0.1, rel=0.03)
