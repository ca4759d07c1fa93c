"""The conventions of the package's docstring: one case each, that fails when the convention flips."""

import cv2
import numpy as np
import pytest

from pipeline.geometry import camera, gaussian, se3, so3

QUARTER_TURN = so3.from_rpy_deg([0.0, 0.0, 90.0])  # about the vertical: body x points along world y


def names_cancel():
    """A camera 2 m up on a body that stands at (100, 200) and is turned left by 90 degrees."""
    T_world_body = se3.from_rotation_translation(QUARTER_TURN, [100.0, 200.0, 0.0])
    T_body_camera = se3.from_rotation_translation(np.eye(3), [3.0, 0.0, 2.0])
    T_world_camera = T_world_body @ T_body_camera
    return se3.transform(T_world_camera, np.array([1.0, 0.0, 0.0])), [100.0, 204.0, 2.0]


def an_inverse_swaps_the_names():
    T_world_body = se3.from_rotation_translation(QUARTER_TURN, [100.0, 200.0, 0.0])
    return se3.transform(se3.inverse(T_world_body), np.array([100.0, 204.0, 2.0])), [4.0, 0.0, 2.0]


def translation_comes_first():
    return se3.exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))[:3, 3], [1.0, 2.0, 3.0]


def errors_are_applied_on_the_right():
    """Forward by 1 m is northward for a body that faces north; turning it does not move it."""
    T_world_body = se3.from_rotation_translation(QUARTER_TURN, [100.0, 200.0, 0.0])
    forward = se3.retract(T_world_body, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    turned = se3.retract(T_world_body, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    return [*forward[:3, 3], *turned[:3, 3]], [100.0, 201.0, 0.0, 100.0, 200.0, 0.0]


def differences_are_taken_on_the_right():
    T_world_body = se3.from_rotation_translation(QUARTER_TURN, [100.0, 200.0, 0.0])
    T_world_later = se3.from_rotation_translation(QUARTER_TURN, [100.0, 201.0, 0.0])
    return se3.local(T_world_body, T_world_later), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def rotation_is_first_only_for_the_others():
    return se3.swap_rotation_first(np.arange(6.0)), [3.0, 4.0, 5.0, 0.0, 1.0, 2.0]


def published_covariance_is_e_n_h_re_rn_rh():
    """Forward is north: the variance along body x (1) is that of the northing, about body x (4) of rn."""
    T_world_body = se3.from_rotation_translation(QUARTER_TURN, [100.0, 200.0, 0.0])
    cov_grid = se3.to_grid_covariance(T_world_body, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    return np.diag(cov_grid), [2.0, 1.0, 3.0, 5.0, 4.0, 6.0]


def published_columns_run_row_by_row():
    cov = np.zeros((6, 6))
    cov[0, 5] = cov[5, 0] = 7.0  # e, rh: the last of the first row
    return gaussian.upper_triangle(cov)[:7], [0.0, 0.0, 0.0, 0.0, 0.0, 7.0, 0.0]


def camera_looks_along_z_with_x_right_and_y_down():
    """To the right of and below the axis: larger column, larger row; and only in front."""
    intrinsics = np.array([100.0, 100.0, 50.0, 40.0, 0, 0, 0, 0, 0])
    uv = camera.project(np.array([[0.2, 0.1, 1.0], [0.2, 0.1, -1.0]]), intrinsics)
    return uv, [[70.0, 50.0], [np.nan, np.nan]]


def pixel_zero_is_the_centre_of_the_top_left_pixel():
    """OpenCV paints a print enlarged 4 times, at which the two conventions differ by 1.5 px."""
    print_ = np.zeros((60, 80))
    print_[20, 30] = 1.0
    print_ = cv2.GaussianBlur(print_, (0, 0), 2.0)
    # The centre of print pixel (i, j) is at x = i, y = j millimetres, 1 m away: f = 4 px per mm.
    intrinsics = np.array([4000.0, 4000.0, 10.0, 5.0, 0, 0, 0, 0, 0])
    homography = np.array([[4.0, 0.0, 10.0], [0.0, 4.0, 5.0], [0.0, 0.0, 1.0]])
    image = cv2.warpPerspective(print_, homography, (400, 300))
    rows, columns = np.indices(image.shape)
    centroid = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    return camera.project(np.array([0.030, 0.020, 1.0]), intrinsics), centroid.round(2)


def roll_turns_about_x_first_and_yaw_about_z_last():
    """Roll 90 takes y up to z; pitch 90 then lays it along x; yaw 90 turns it to y. In another order: not."""
    return so3.from_rpy_deg([90.0, 90.0, 90.0]) @ [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]


def a_quaternion_has_its_scalar_last():
    return so3.to_quaternion(np.eye(3)), [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    "convention",
    [
        names_cancel,
        an_inverse_swaps_the_names,
        translation_comes_first,
        errors_are_applied_on_the_right,
        differences_are_taken_on_the_right,
        rotation_is_first_only_for_the_others,
        published_covariance_is_e_n_h_re_rn_rh,
        published_columns_run_row_by_row,
        camera_looks_along_z_with_x_right_and_y_down,
        pixel_zero_is_the_centre_of_the_top_left_pixel,
        roll_turns_about_x_first_and_yaw_about_z_last,
        a_quaternion_has_its_scalar_last,
    ],
    ids=lambda convention: convention.__name__,
)
def test_convention(convention):
    got, expected = convention()
    assert np.allclose(got, expected, rtol=0, atol=1e-12, equal_nan=True), (got, expected)
