"""Homographies against closed forms and OpenCV."""

import cv2
import numpy as np
import pytest

from pipeline.geometry import homography

H_TRUE = np.array([[900, 40, 600], [-30, 850, 400], [0.1, -0.2, 1.0]])
SQUARE = np.array([[-0.13, 0.13], [0.13, 0.13], [0.13, -0.13], [-0.13, -0.13]])


def image(H, xy):
    p = np.concatenate([xy, np.ones(xy.shape[:-1] + (1,))], axis=-1) @ np.swapaxes(H, -1, -2)
    return p[..., :2] / p[..., 2:]


def rounded(xy):
    """OpenCV fits single precision."""
    return xy.astype(np.float32).astype(np.float64)


def test_a_homography_is_got_back_from_four_points_and_from_many():
    rng = np.random.default_rng(0)
    elsewhere = rng.uniform(-1, 1, (9, 2))
    for xy in (SQUARE, rng.uniform(-1, 1, (20, 2))):
        H = homography.from_points(xy, image(H_TRUE, xy))
        # Nine points within seven sides of the square, pixels of the order of 1,000.
        assert np.allclose(image(H, elsewhere), image(H_TRUE, elsewhere), rtol=0, atol=1e-9)


def test_the_mean_of_the_points_has_w_1_whatever_the_signs_of_the_truth():
    xy = SQUARE + [0.4, -0.3]
    for sign in (1.0, -1.0):
        H = homography.from_points(xy, image(sign * H_TRUE, xy))
        w = np.append(xy.mean(axis=0), 1.0) @ H_TRUE[2]
        assert np.allclose(H, H_TRUE / w, rtol=1e-9)


def test_four_noisy_points_are_met_as_opencv_meets_them():
    rng = np.random.default_rng(4)
    xy = rounded(7 * SQUARE)
    for _ in range(20):
        uv = rounded(image(H_TRUE, xy) + rng.normal(0, 0.1, (4, 2)))
        theirs, _ = cv2.findHomography(xy, uv)
        assert np.allclose(
            image(homography.from_points(xy, uv), 0.5 * xy), image(theirs, 0.5 * xy), atol=1e-6
        )


@pytest.mark.parametrize("points", [6, 40])
def test_noisy_points_are_fitted_nearly_as_well_as_by_the_error_in_the_picture(points):
    """OpenCV goes on from the algebraic error to that in the picture, which is the best that can be had."""
    rng = np.random.default_rng(points)
    ours, theirs = [], []
    for _ in range(300):
        xy = rounded(np.concatenate([7 * SQUARE, rng.uniform(-1, 1, (points - 4, 2))]))
        truth = image(H_TRUE, xy)
        uv = rounded(truth + rng.normal(0, 0.1, (points, 2)))
        ours.append(image(homography.from_points(xy, uv), xy) - truth)
        theirs.append(image(cv2.findHomography(xy, uv)[0], xy) - truth)
    ratio = np.sqrt(np.mean(np.square(ours)) / np.mean(np.square(theirs)))
    print(f"{points} points: RMS error {ratio:.4f} times OpenCV's")
    assert 0.99 < ratio < 1.03


def test_a_batch_is_its_parts():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-1, 1, (2, 3, 7, 2))
    uv = image(H_TRUE, xy) + rng.normal(0, 0.1, xy.shape)
    weight = rng.uniform(0.5, 2.0, (2, 3, 7))
    H = homography.from_points(xy, uv, weight)
    assert H.shape == (2, 3, 3, 3)
    for k in np.ndindex(2, 3):
        assert np.allclose(H[k], homography.from_points(xy[k], uv[k], weight[k]), rtol=1e-9, atol=1e-9)


def test_a_weight_of_two_is_the_point_twice_and_of_zero_no_point():
    rng = np.random.default_rng(2)
    xy = rng.uniform(-1, 1, (8, 2))
    uv = image(H_TRUE, xy) + rng.normal(0, 0.5, xy.shape)
    rows = [0, 1, 2, 3, 4, 5, 5]
    weight = np.array([1, 1, 1, 1, 1, 2, 0, 0.0])
    H = homography.from_points(xy, uv, weight)
    assert np.allclose(H, homography.from_points(xy[rows], uv[rows]), rtol=1e-9, atol=1e-9)


def test_where_the_points_lie_and_in_what_units_costs_no_digits():
    """A square of 0.26 m, a kilometre off and in millimetres: the same places in the picture."""
    uv = image(H_TRUE, SQUARE)
    inside = 0.5 * SQUARE
    H = homography.from_points(1e3 * (SQUARE + 1e3), uv)
    # A kilometre in millimetres leaves 1e-10 of a millimetre, and 900 px are a metre.
    assert np.allclose(image(H, 1e3 * (inside + 1e3)), image(H_TRUE, inside), rtol=0, atol=1e-6)


def test_points_that_fix_no_homography_give_nan_and_leave_their_neighbours_alone():
    line = np.array([[0.0, 0], [1, 1], [2, 2], [3, 3]])
    three = np.array([[0.0, 0], [1, 1], [2, 2], [0, 3]])
    one = np.zeros((4, 2))
    xy = np.stack([line, SQUARE, three, one])
    H = homography.from_points(xy, image(H_TRUE, xy))
    assert np.isnan(H).all(axis=(-1, -2)).tolist() == [True, False, True, True]
    assert np.allclose(image(H[1], SQUARE), image(H_TRUE, SQUARE), rtol=0, atol=1e-9)
