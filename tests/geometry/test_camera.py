"""The camera against OpenCV and central differences; its inverse against itself, up to the fold."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry import camera

LENSES = {
    "no distortion": [1731.0, 1725.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "barrel": [1000.0, 1005.0, 655.0, 470.0, -0.3, 0.12, 0.001, -0.0008, -0.02],
    "strong barrel": [600.0, 610.0, 640.0, 480.0, -0.32, 0.1, 0.001, -0.002, -0.012],
    "pincushion": [900.0, 890.0, 630.0, 490.0, 0.15, 0.05, -0.001, 0.002, 0.01],
    "k1 only": [1200.0, 1200.0, 640.0, 480.0, -0.25, 0.0, 0.0, 0.0, 0.0],
}
lenses = pytest.mark.parametrize("intrinsics", [np.array(k) for k in LENSES.values()], ids=list(LENSES))


def points_in_view(intrinsics, count=500, share_of_fold=0.95):
    """Points up to 50 degrees off the axis, or up to the given share of the fold radius."""
    rng = np.random.default_rng(4)
    r = np.sqrt(rng.uniform(0, 1, count)) * min(share_of_fold * camera.fold_radius(intrinsics), 1.2)
    turn = rng.uniform(0, 2 * np.pi, count)
    xy1 = np.stack([r * np.cos(turn), r * np.sin(turn), np.ones(count)], axis=-1)
    return xy1 * rng.uniform(0.5, 30.0, size=(count, 1))


def central_differences(f, x, step):
    columns = [(f(x + d) - f(x - d)) / (2 * step) for d in step * np.eye(x.shape[-1])]
    return np.stack(columns, axis=-1)


@lenses
def test_projection_is_opencvs(intrinsics):
    p = points_in_view(intrinsics)
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, intrinsics[4:])
    assert np.allclose(camera.project(p, intrinsics), theirs[:, 0], rtol=0, atol=1e-10)


@lenses
def test_projection_jacobians_match_central_differences(intrinsics):
    p = points_in_view(intrinsics)
    uv, J_uv_p, J_uv_intrinsics = camera.project_with_jacobians(p, intrinsics)
    assert np.array_equal(uv, camera.project(p, intrinsics))
    # px/m reaches 5,000 at half a metre: 1e-9 relative is rounding over the step.
    numeric = central_differences(lambda x: camera.project(x, intrinsics), p, 1e-6)
    assert np.allclose(J_uv_p, numeric, rtol=1e-6, atol=1e-5)
    numeric = central_differences(
        lambda k: camera.project(p, k), np.broadcast_to(intrinsics, (len(p), 9)), 1e-4
    )
    assert np.allclose(J_uv_intrinsics, numeric, rtol=1e-6, atol=1e-6)  # linear in all nine


@lenses
def test_undistortion_undoes_distortion_to_1e_12(intrinsics):
    p = points_in_view(intrinsics, share_of_fold=0.98)
    xy = camera.undistort(camera.project(p, intrinsics), intrinsics)
    assert np.allclose(xy, p[:, :2] / p[:, 2:], rtol=0, atol=1e-12)


@settings(derandomize=True, deadline=None)
@given(
    st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05),
    st.floats(-0.003, 0.003), st.floats(-0.003, 0.003),
)  # fmt: skip
def test_undistortion_returns_the_ray_or_nan_for_any_lens(k1, k2, k3, p1, p2):
    intrinsics = np.array([1000.0, 1000.0, 640.0, 480.0, k1, k2, p1, p2, k3])
    uv = np.stack(np.meshgrid(np.linspace(0, 1280, 9), np.linspace(0, 960, 7)), axis=-1)
    xy = camera.undistort(uv, intrinsics)
    found = np.isfinite(xy[..., 0])
    rays = np.concatenate([xy, np.ones((7, 9, 1))], axis=-1)
    assert np.allclose(camera.project(rays, intrinsics)[found], uv[found], rtol=0, atol=1e-9)
    assert np.all(np.linalg.norm(xy[found], axis=-1) <= camera.fold_radius(intrinsics))


def test_undistortion_gives_up_no_pixel_inside_the_rim_of_any_plausible_lens():
    rng = np.random.default_rng(0)
    low, high = [-0.45, -0.2, -0.003, -0.003, -0.08], [0.45, 0.3, 0.003, 0.003, 0.08]
    lens = np.hstack([np.tile([1000.0, 1000.0, 640.0, 480.0], (3000, 1)), rng.uniform(low, high, (3000, 5))])
    lens = lens[:, None]
    r = np.array([0.3, 0.6, 0.9, 0.97]) * np.minimum(camera.fold_radius(lens), 1.5)
    turn = rng.uniform(0, 2 * np.pi, size=r.shape)
    xy = np.stack([r * np.cos(turn), r * np.sin(turn)], axis=-1)
    rays = np.concatenate([xy, np.ones((*r.shape, 1))], axis=-1)
    uv, J_uv_p, _ = camera.project_with_jacobians(rays, lens)
    # Where the slope all but vanishes the tangential terms fold the lens too, and a pixel has two rays.
    unique = np.linalg.svd(J_uv_p[..., :2] / 1000.0)[1][..., 1] > 0.02
    assert unique.mean() > 0.999
    # Rounding of 1e-16, grown by 1 / 0.02 and by the size of the coordinates.
    assert np.allclose(camera.undistort(uv, lens)[unique], xy[unique], rtol=0, atol=1e-12)


def test_no_ray_is_invented_for_a_pixel_beyond_the_fold():
    intrinsics = np.array(LENSES["k1 only"])
    r = camera.fold_radius(intrinsics)
    farthest = 1200.0 * r * (1 - 0.25 * r * r)  # px from the centre
    uv = np.array([[640.0 + 0.99 * farthest, 480.0], [640.0 + 1.01 * farthest, 480.0]])
    xy = camera.undistort(uv, intrinsics)
    assert np.isfinite(xy[0]).all()
    assert np.isnan(xy[1]).all()


def test_fold_radius_of_k1_alone_is_the_root_of_its_slope():
    intrinsics = np.array(LENSES["k1 only"])
    assert camera.fold_radius(intrinsics) == pytest.approx(1 / np.sqrt(3 * 0.25), rel=1e-12)


@lenses
def test_fold_radius_is_where_the_image_radius_stops_growing(intrinsics):
    k1, k2, k3 = intrinsics[[4, 5, 8]]
    r = np.linspace(0, 20, 2_000_001)
    growing = np.diff(r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)) > 0
    brute_force = np.inf if growing.all() else r[np.argmin(growing)]
    assert camera.fold_radius(intrinsics) == pytest.approx(brute_force, abs=2e-5)


def test_fold_radius_finds_the_first_of_several_folds():
    # 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ = (1 - s)(1 - s/4)(1 + s): folds at r = 1, unfolds at 2.
    intrinsics = np.array([1.0, 1.0, 0.0, 0.0, -0.25 / 3, -1 / 5, 0.0, 0.0, 0.25 / 7])
    assert camera.fold_radius(intrinsics) == pytest.approx(1.0, rel=1e-12)


def test_a_point_behind_the_camera_has_no_pixel():
    p = np.array([[0.1, 0.2, 5.0], [0.1, 0.2, -5.0], [0.1, 0.2, 0.0]])
    assert camera.in_front(p).tolist() == [True, False, False]
    uv, J_uv_p, J_uv_intrinsics = camera.project_with_jacobians(p, np.array(LENSES["barrel"]))
    assert np.isfinite(uv[0]).all()
    assert np.isnan(uv[1:]).all()
    assert np.isnan(J_uv_p[1:]).all()
    assert not np.isfinite(J_uv_intrinsics[1:, :, 4:]).any()


def test_one_camera_per_row_gives_what_each_camera_gives():
    many = np.array([LENSES[k] for k in ("barrel", "strong barrel", "pincushion")])
    p = np.random.default_rng(6).uniform([-1, -1, 4], [1, 1, 9], size=(3, 4, 3))
    uv, J_uv_p, J_uv_intrinsics = camera.project_with_jacobians(p, many[:, None])
    assert (uv.shape, J_uv_p.shape, J_uv_intrinsics.shape) == ((3, 4, 2), (3, 4, 2, 3), (3, 4, 2, 9))
    xy = camera.undistort(uv, many[:, None])
    for i in range(3):
        assert np.allclose(uv[i], camera.project(p[i], many[i]), rtol=0, atol=1e-12)
        assert np.allclose(xy[i], camera.undistort(uv[i], many[i]), rtol=0, atol=1e-14)
