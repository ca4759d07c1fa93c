"""Intrinsics from views: OpenCV, a dense solve, and drawn lenses as oracles."""

import cv2
import numpy as np
import pytest

from pipeline.calibration import view_errors
from pipeline.calibration.intrinsics import solve
from pipeline.calibration.start import first_guess
from pipeline.calibration.view_errors import with_shared_errors
from pipeline.calibration.views import View
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.geometry.lenses import BROWN5, FISHEYE, LENSES
from tests.calibration.views_of_truth import BOARD, SIZE, TRUTH, drawn_views

each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def solved(lens, views, bends=False):
    k, T = first_guess(lens, views, BOARD.corners_m, SIZE)
    return solve(lens, views, BOARD.corners_m, k, T, bends)


@each_lens
def test_without_errors_the_lens_comes_back(lens):
    views, T = drawn_views(lens, sigma_px=0.0)
    # A little, or sigma0 of nothing would make outliers of rounding.
    rng = np.random.default_rng(1)
    views = [View(v.name, v.point, v.uv + rng.normal(0, 1e-7, v.uv.shape), v.cov) for v in views]
    found = solved(lens, views, bends=True)
    d = BOARD.corners_m @ [0, 0, 1] + 1.0
    seen = np.column_stack([BOARD.corners_m[:, :2] - 0.2, d])
    assert np.allclose(lens.project(seen, found.intrinsics), lens.project(seen, TRUTH[lens.name]), atol=1e-4)
    assert np.allclose(found.intrinsics[:4], TRUTH[lens.name][:4], atol=5e-3)
    assert np.allclose(found.T_camera_board, T, atol=1e-5)


def test_the_answer_is_that_of_opencv():
    views, _ = drawn_views(BROWN5, seed=5)
    found = solved(BROWN5, views)
    assert found.outliers == 0
    points = [BOARD.corners_m[v.point[:, 0]].astype(np.float32) for v in views]
    uv = [v.uv.astype(np.float32) for v in views]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    rms, K, d, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
        points, uv, SIZE, None, None, criteria=criteria
    )
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:5]])
    # Theirs starts from single precision, so a hundredth of a sigma is the most that can be asked.
    assert np.all(np.abs(found.intrinsics - theirs) < 0.02 * found.sigma)
    assert found.rms_px == pytest.approx(rms / np.sqrt(2), rel=1e-3)
    # OpenCV scales by the root of all observations less unknowns, as we do.
    assert np.allclose(found.sigma, sigma.ravel()[:9], rtol=0.02)


def test_the_fisheye_is_that_of_opencv():
    views, _ = drawn_views(FISHEYE, count=10, seed=6)
    views = [v for v in views if len(v.point) == len(BOARD.corners_m)]
    found = solved(FISHEYE, views)
    points = [BOARD.corners_m[v.point[:, 0]].reshape(1, -1, 3) for v in views]
    k = TRUTH["fisheye"]
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC + cv2.CALIB_FIX_SKEW + cv2.CALIB_USE_INTRINSIC_GUESS
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    _, K, d, _, _ = cv2.fisheye.calibrate(
        points,
        [v.uv.reshape(1, -1, 2) for v in views],
        SIZE,
        K,
        k[4:].reshape(4, 1),
        flags=flags,
        criteria=criteria,
    )
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()])
    assert np.all(np.abs(found.intrinsics - theirs) < 0.02 * found.sigma)


def test_the_covariance_is_that_of_a_dense_solve():
    views, _ = drawn_views(BROWN5, count=5, seed=7)
    found = solved(BROWN5, views, bends=True)
    assert found.shared_factor == 1.0
    n, v = 9, len(views)
    p = BOARD.corners_m
    a = (p[:, :2] - p[:, :2].mean(axis=0)) / (0.5 * np.ptp(p[:, :2], axis=0))

    def predicted(x):
        out = []
        for i, view in enumerate(views):
            q = p.copy()
            q[:, 2] += (1 - a**2) @ (found.bend_m + x[n : n + 2])
            T = found.T_camera_board[i] @ se3.exp(x[n + 2 + 6 * i : n + 8 + 6 * i])
            out.append(
                BROWN5.project(se3.transform(T, q[view.point[:, 0]]), found.intrinsics + x[:n]).ravel()
            )
        return np.concatenate(out)

    size = n + 2 + 6 * v
    step = np.concatenate([np.full(4, 1e-3), np.full(size - 4, 1e-6)])
    J = np.stack([(predicted(e) - predicted(-e)) / (2 * h) for e, h in zip(np.diag(step), step)], axis=1)
    r = np.concatenate([part.ravel() for part in found.residual_px])
    dense = np.linalg.inv(J.T @ J) * (r @ r) / (len(r) - size)
    assert np.allclose(J.T @ r / np.linalg.norm(J, axis=0), 0, atol=1e-4), "not where the squares are least"
    relative = (found.covariance - dense[:n, :n]) / np.sqrt(np.outer(np.diag(dense), np.diag(dense))[:n, :n])
    assert np.max(np.abs(relative)) < 1e-3


@pytest.mark.slow
def test_normalised_errors_of_drawn_views_are_those_of_a_normal_distribution():
    z, chi = [], []
    for seed in range(60):
        views, _ = drawn_views(BROWN5, count=12, seed=100 + seed)
        found = solved(BROWN5, views, bends=True)
        error = found.intrinsics - TRUTH["brown5"]
        z.append(error / found.sigma)
        chi.append(error @ np.linalg.solve(found.covariance, error))
    # 60 draws of nine: the root mean square of chi-squares with 9 degrees over 60 has a standard deviation of 3 %.
    assert np.sqrt(np.mean(chi) / 9) == pytest.approx(1.0, abs=0.1)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.15)


def test_corners_far_off_are_left_out_and_change_nothing_much():
    views, _ = drawn_views(BROWN5, seed=8)
    clean = solved(BROWN5, views)
    rng = np.random.default_rng(3)
    dirty = [View(v.name, v.point, v.uv.copy(), v.cov) for v in views]
    for view in dirty:
        view.uv[rng.integers(0, len(view.uv), 2)] += rng.choice([-1, 1], (2, 1, 2)) * rng.uniform(
            2, 8, (2, 1, 2)
        )
    found = solved(BROWN5, dirty)
    assert 20 <= found.outliers <= 24
    assert np.all(np.abs(found.intrinsics - clean.intrinsics) < clean.sigma)


def test_a_view_with_many_corners_off_is_left_out_whole():
    views, _ = drawn_views(BROWN5, seed=8)
    views[4].uv[: len(views[4].uv) // 3] += 3.0
    found = solved(BROWN5, views)
    assert list(np.flatnonzero(~found.views_used)) == [4]
    assert np.all(np.abs(found.intrinsics - TRUTH["brown5"]) < 4 * found.sigma)


def test_covariances_of_single_corners_count():
    """Half the corners ten times worse and said so: the answer is as if they were hardly there."""
    z = []
    for seed in range(15):
        views, _ = drawn_views(BROWN5, seed=300 + seed)
        rng = np.random.default_rng(seed)
        for view in views:
            bad = np.arange(len(view.uv)) % 2 == 0
            view.uv[bad] += rng.normal(0, 1.0, view.uv[bad].shape)
            view.cov[bad] *= 1 + 10.0**2
        found = solved(BROWN5, views)
        assert found.sigma0 == pytest.approx(1.0, abs=0.1)
        z.append((found.intrinsics - TRUTH["brown5"]) / found.sigma)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_views_that_err_together_widen_the_covariance(monkeypatch):
    """A lens that refocuses by 1.5 % from view to view: the plain covariance is too small by far."""

    def errors(seed):
        views, _ = drawn_views(
            BROWN5, count=14, seed=500 + seed,
            per_view=lambda k, rng: k * np.concatenate([np.full(2, 1 + rng.normal(0, 0.015)), np.ones(7)]),
        )  # fmt: skip
        found = solved(BROWN5, views)
        return (found.intrinsics - TRUTH["brown5"])[:2] / found.sigma[:2]

    grown = np.array([errors(seed) for seed in range(20)])
    monkeypatch.setattr(view_errors, "CHANCE", 0.0)
    plain = np.array([errors(seed) for seed in range(20)])
    assert np.sqrt(np.mean(plain**2)) > 3.0
    assert np.sqrt(np.mean(grown**2)) < 2.0


def test_without_shared_errors_the_factor_is_one_in_99_of_100():
    rng = np.random.default_rng(9)
    factors = []
    for _ in range(400):
        J = rng.normal(size=(10, 30, 4))
        noise = rng.normal(size=(10, 30))
        J_all = J.reshape(-1, 4)
        x, *_ = np.linalg.lstsq(J_all, noise.ravel(), rcond=None)
        residual = noise - J @ x
        factors.append(with_shared_errors(np.swapaxes(J, 1, 2) @ J, np.einsum("vij,vi->vj", J, residual))[1])
    beyond = np.count_nonzero(np.array(factors) > 1)
    assert beyond <= 12  # 4 expected; 12 has a probability below 1e-3


def test_the_factor_is_what_the_jackknife_says():
    """Leaving each view out and solving again, on a linear problem: the same sum of squares."""
    rng = np.random.default_rng(10)
    J = rng.normal(size=(8, 20, 3))
    noise = rng.normal(size=(8, 20)) + rng.normal(0, 1.5, (8, 1)) * J[..., 0]
    whole, *_ = np.linalg.lstsq(J.reshape(-1, 3), noise.ravel(), rcond=None)
    S = np.einsum("vij,vik->jk", J, J)
    moved, expected = 0.0, 0.0
    for v in range(8):
        rest = np.arange(8) != v
        x, *_ = np.linalg.lstsq(J[rest].reshape(-1, 3), noise[rest].ravel(), rcond=None)
        moved += (whole - x) @ S @ (whole - x)
        # The covariance of that difference with errors of variance one, from its linear map.
        J_all = J.reshape(-1, 3)
        A = np.linalg.pinv(J_all)
        B = np.zeros_like(A)
        B[:, np.repeat(rest, 20)] = np.linalg.pinv(J[rest].reshape(-1, 3))
        expected += np.trace(S @ (A - B) @ (A - B).T)
    residual = noise - J @ whole
    covariance, found = with_shared_errors(np.swapaxes(J, 1, 2) @ J, np.einsum("vij,vi->vj", J, residual))
    assert found > 1
    grown = np.linalg.eigvals(covariance @ S)
    assert np.all(grown > found * (1 - 1e-9)) and np.max(grown) > found * 1.01
    assert found == pytest.approx(moved / expected, rel=1e-9)


def test_a_board_that_is_bent_is_found_bent():
    k, T = TRUTH["brown5"], drawn_views(BROWN5)[1]
    p = BOARD.corners_m.copy()
    a = (p[:, :2] - p[:, :2].mean(axis=0)) / (0.5 * np.ptp(p[:, :2], axis=0))
    p[:, 2] += (1 - a**2) @ [0.002, -0.001]
    rng = np.random.default_rng(0)
    views = drawn_views(BROWN5)[0]
    for view, pose in zip(views, T):
        uv = BROWN5.project(se3.transform(pose, p[view.point[:, 0]]), k)
        view.uv[:, 0] = uv + rng.normal(0, 0.05, uv.shape)
    found = solved(BROWN5, views, bends=True)
    assert np.allclose(found.bend_m, [0.002, -0.001], atol=1e-4)
    assert np.all(np.abs(found.intrinsics - k) < 4 * found.sigma)
    assert solved(BROWN5, views, bends=False).rms_px > 1.3 * found.rms_px


def test_corners_of_no_board_are_refused():
    rng = np.random.default_rng(4)
    views = [View(v.name, v.point, rng.uniform(0, 480, v.uv.shape), v.cov) for v in drawn_views(BROWN5)[0]]
    with pytest.raises(CalibrationError, match="board"):
        found = solved(BROWN5, views)
        assert found.rms_px < 5, "the caller refuses such a residual"
        pytest.fail("random corners were believed")
