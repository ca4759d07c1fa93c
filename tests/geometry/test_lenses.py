"""Lens models against OpenCV and central differences."""

import cv2
import numpy as np
import pytest

from pipeline.geometry.lenses import BROWN5, BROWN8, FISHEYE, LENSES

EXAMPLES = {
    "brown5": np.array([905.0, 899.0, 641.0, 357.0, -0.21, 0.07, 0.0008, -0.0011, -0.012]),
    "brown8": np.array([905.0, 899.0, 641.0, 357.0, 0.31, -0.12, 0.0008, -0.0011, 0.03, 0.52, -0.08, 0.02]),
    "fisheye": np.array([520.0, 518.0, 641.0, 357.0, 0.05, -0.013, 0.006, -0.0015]),
}
each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def points(n=60, seed=3):
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.4, 3.0, n)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)) * z[:, None], z])


def by_opencv(lens, p, k):
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1.0]])
    if lens is FISHEYE:
        uv, _ = cv2.fisheye.projectPoints(p[:, None], np.zeros(3), np.zeros(3), K, k[4:])
    else:
        uv, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, k[4:])
    return uv[:, 0]


@each_lens
def test_pixels_are_those_of_opencv(lens):
    p, k = points(), EXAMPLES[lens.name]
    assert np.allclose(lens.project(p, k), by_opencv(lens, p, k), atol=1e-9)


@each_lens
def test_jacobians_match_central_differences(lens):
    # The point on the axis stands in too: there the fisheye is a series.
    p, k = np.vstack([points(), [[0, 0, 1.0], [1e-5, 0, 1.0]]]), EXAMPLES[lens.name]
    _, J_p, J_k = lens.project_with_jacobians(p, k)
    for i in range(3):
        d = np.eye(3)[i] * 1e-6
        assert np.allclose(J_p[..., i], (lens.project(p + d, k) - lens.project(p - d, k)) / 2e-6, atol=1e-4)
    for i in range(len(lens)):
        d = np.eye(len(lens))[i] * (1e-4 if i < 4 else 1e-6)
        numeric = (lens.project(p, k + d) - lens.project(p, k - d)) / (2 * d[i])
        assert np.allclose(J_k[..., i], numeric, atol=1e-4), lens.parameters[i]


@each_lens
def test_directions_lead_back_to_their_pixels(lens):
    k = EXAMPLES[lens.name]
    uv = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 719, 7)), axis=-1)
    d, _ = lens.directions(uv, k)
    assert np.allclose(np.linalg.norm(d, axis=-1), 1)
    assert np.allclose(lens.project(3.0 * d, k), uv, atol=1e-8)


@each_lens
def test_directions_move_with_the_intrinsics_as_central_differences_say(lens):
    k = EXAMPLES[lens.name]
    uv = np.stack(np.meshgrid(np.linspace(5, 1270, 7), np.linspace(5, 710, 5)), axis=-1)
    _, J = lens.directions(uv, k)
    for i in range(len(lens)):
        d = np.eye(len(lens))[i] * (1e-3 if i < 4 else 1e-6)
        numeric = (lens.directions(uv, k + d)[0] - lens.directions(uv, k - d)[0]) / (2 * d[i])
        assert np.allclose(J[..., i], numeric, atol=1e-6), lens.parameters[i]


def test_pixels_that_no_ray_reaches_are_nan():
    # r (1 - 0.5 r²) is never above 0.545.
    k = np.array([1000.0, 1000, 500, 500, -0.5, 0, 0, 0, 0, 0, 0, 0])
    far = np.array([[500.0 + 560.0, 500.0], [500.0 + 500.0, 500.0]])
    for lens in (BROWN5, BROWN8):
        found = lens.undistorted(far, k[: len(lens)])
        assert np.isnan(found[0]).all() and np.isfinite(found[1]).all()
    assert np.isnan(FISHEYE.undistorted(np.array([2000.0, 500.0]), EXAMPLES["fisheye"])).all()
    assert np.isnan(BROWN5.project(np.array([0.1, 0.1, -1.0]), k[:9])).all()
