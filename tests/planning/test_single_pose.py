"""Figs. 7 to 9 of the paper by planning's own formula, against OpenCV's projection and closed forms."""

import cv2
import numpy as np
import pytest

from pipeline.geometry import se3
from pipeline.planning.single_pose import (
    SIGMA_U_PX,
    board,
    by_distance,
    facing,
    off_the_ray_deg,
    pinhole,
    pose_covariance,
    position_sigmas,
    power,
    square,
)

FOCAL = 1731.0


def by_opencv(T, corners, focal, others=()):
    """Eq. (3) with OpenCV's projection by central differences; (6, 6)."""
    K = np.array([[focal, 0, 639.5], [0, focal, 479.5], [0, 0, 1.0]])

    def image(delta):
        uv = []
        moved = T @ se3.exp(delta)
        for T_other in (np.eye(4), *others):
            P = np.linalg.inv(T_other) @ moved
            rvec, _ = cv2.Rodrigues(P[:3, :3])
            uv.append(cv2.projectPoints(corners, rvec, P[:3, 3], K, None)[0].ravel())
        return np.concatenate(uv)

    h = 1e-6
    J = np.stack([(image(h * e) - image(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    return SIGMA_U_PX**2 * np.linalg.inv(J.T @ J)


@pytest.mark.parametrize("beside", [(), (1.2,), (0.6, 1.2)])
@pytest.mark.parametrize("corners", [square(0.6), board(0.2, 0.3, 2, 3)], ids=["tag", "board"])
def test_it_is_eq_3_with_opencvs_projection(corners, beside):
    others = [se3.from_rotation_translation(np.eye(3), np.array([b, 0, 0.0])) for b in beside]
    T = facing(9.0, 35.0, 70.0, (0.1, -0.15, 1.0))
    ours, other = (
        pose_covariance(T, corners, pinhole(FOCAL), T_camera_others=others),
        by_opencv(T, corners, FOCAL, others),
    )
    scale = np.sqrt(np.outer(np.diagonal(other), np.diagonal(other)))
    assert np.abs((ours - other) / scale).max() < 1e-5


def test_the_depth_of_a_tag_that_faces_the_camera_has_a_closed_form():
    """Fronto-parallel, depth is told by the size in the picture alone: sigma_Z = Z² sigma / (sqrt(2) f s)."""
    found, direction = position_sigmas(facing(10.0, 0.0), square(0.6), pinhole(FOCAL))
    assert found[2] == pytest.approx(100 * SIGMA_U_PX / (np.sqrt(2) * FOCAL * 0.6), rel=0.01)
    assert abs(direction[2]) == pytest.approx(1.0, abs=1e-3)


def test_figure_7_along_the_line_of_sight():
    rng = np.random.default_rng(3)
    n = 200
    ray = np.column_stack([rng.uniform(-0.3, 0.3, n), rng.uniform(-0.22, 0.22, n), np.ones(n)])
    T = facing(rng.uniform(3, 25, n), rng.uniform(10, 60, n), rng.uniform(0, 360, n), ray)
    _, direction = position_sigmas(T, square(0.6), pinhole(FOCAL))
    assert off_the_ray_deg(T, direction).max() < 5.0


def test_figure_8_with_the_square_of_the_distance():
    z = np.geomspace(4, 30, 12)
    found, _ = position_sigmas(facing(z), square(0.6), pinhole(FOCAL))
    assert power(z, found[:, 2]) == pytest.approx(2.0, abs=0.05)
    assert power(z, found[:, 0]) < 1.2


def test_figure_9_with_the_focal_length_at_constant_size_in_the_picture():
    f = np.geomspace(600, 2500, 8)
    largest = [position_sigmas(facing(0.008 * a), square(0.6), pinhole(a))[0][2] for a in f]
    assert power(f, largest) == pytest.approx(1.0, abs=0.05)
    fixed = [position_sigmas(facing(10.0), square(0.6), pinhole(a))[0][2] for a in f]
    assert power(f, fixed) == pytest.approx(-1.0, abs=0.08)


def test_a_second_camera_at_a_base_takes_the_depth_down():
    """Two rays at a base b: sigma_Z of triangulation, Z² sigma / (f b) times sqrt(2) over the root of the corners."""
    T = facing(12.0, 30.0)
    one = position_sigmas(T, square(0.3), pinhole(FOCAL))[0][2]
    base = se3.from_rotation_translation(np.eye(3), np.array([3.0, 0, 0]))
    two = position_sigmas(T, square(0.3), pinhole(FOCAL), T_camera_others=[base])[0][2]
    triangulated = 144 * SIGMA_U_PX * np.sqrt(2) / (FOCAL * 3.0) / np.sqrt(4)
    assert two < 0.2 * one and two == pytest.approx(triangulated, rel=0.15)


def test_a_job_of_ones_own_is_the_same_formula():
    """At constant sigma the square of the distance; with sigma falling as 1/side the cube."""
    tags = square(0.4)[None]
    z = (6.0, 9.0, 13.5)
    constant, side, off = by_distance(tags, pinhole(FOCAL), lambda px: 0.2, z)
    worse, _, _ = by_distance(tags, pinhole(FOCAL), lambda px: 0.2 * 40 / px, z)
    assert power(z, constant[:, 2]) == pytest.approx(2.0, abs=0.06)
    assert power(z, worse[:, 2]) == pytest.approx(3.0, abs=0.06)
    assert side[1] == pytest.approx(FOCAL * 0.4 / 9 * np.sqrt(np.cos(np.pi / 6))) and off.max() < 5
    assert by_distance(tags, pinhole(FOCAL), lambda px: 0.2, z, factor=2.0)[0][:, 2] == pytest.approx(
        constant[:, 2] / 2, rel=0.02
    )
