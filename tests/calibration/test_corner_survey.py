"""Markers from surveyed corners: poses against SciPy, their scatter, and every fault by its name."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pipeline.calibration.corner_survey import SurveyedMarker, datum_sigma_m, marker_pose
from pipeline.errors import CalibrationError

PRINT = np.array([[-0.4, 0.3, 0], [0.4, 0.3, 0], [0.4, -0.3, 0], [-0.4, -0.3, 0]])
SQUARE = np.array([[-0.4, 0.4, 0], [0.4, 0.4, 0], [0.4, -0.4, 0], [-0.4, -0.4, 0]])
# Upright: x to the east, y up, z to the south.
R = Rotation.from_euler("xyz", [90, 3, 25], degrees=True).as_matrix()
T = np.array([12.0, -7.0, 2.5])
NAMES = ("TL", "TR", "BR", "BL")


def shot(p, sigma=0.001, rng=None):
    q = p @ R.T + T
    return q if rng is None else q + rng.normal(size=p.shape) * sigma


def marker(q, p=PRINT, names=NAMES, sigma=0.001, faces=None):
    return SurveyedMarker("BM1", names[: len(p)], p, q, np.full(len(p), sigma), faces)


def test_the_pose_is_the_least_squares_one_of_another_solver():
    rng = np.random.default_rng(3)
    sigma = np.array([0.001, 0.004, 0.002, 0.001])
    q = shot(PRINT) + rng.normal(size=PRINT.shape) * sigma[:, None]
    found = marker_pose(SurveyedMarker("BM1", NAMES, PRINT, q, sigma))

    def residual(x):
        p = PRINT @ (R @ Rotation.from_rotvec(x[3:]).as_matrix()).T + T + x[:3]
        return ((q - p) / sigma[:, None]).ravel()

    other = least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.T_world_marker[:3, 3] == pytest.approx(T + other.x[:3], abs=1e-8)
    R_other = R @ Rotation.from_rotvec(other.x[3:]).as_matrix()
    assert found.T_world_marker[:3, :3] == pytest.approx(R_other, abs=1e-8)
    assert found.chi_square == pytest.approx(2 * other.cost, rel=1e-6)
    assert found.redundancy == 6
    # Its translation is felt in the marker's axes.
    J = other.jac.copy()
    J[:, :3] = J[:, :3] @ R_other
    cov = np.linalg.inv(J.T @ J)
    assert np.sqrt(np.diagonal(found.covariance)) == pytest.approx(np.sqrt(np.diagonal(cov)), rel=2e-3)


def test_closed_form_of_four_corners():
    found = marker_pose(marker(shot(PRINT), sigma=0.002))
    sigma = np.sqrt(np.diagonal(found.covariance))
    # Mean of four; turns about x and y by the corners' levers, about z by both.
    assert sigma[:3] == pytest.approx(np.full(3, 0.001))
    assert sigma[3:] == pytest.approx([0.001 / 0.3, 0.001 / 0.4, 0.001 / 0.5])
    assert found.sigma_scale == pytest.approx(0.001 / 0.5)
    assert found.scale == pytest.approx(1.0)


def test_errors_lie_within_their_sigmas_and_the_fit_is_as_good_as_it_says():
    rng = np.random.default_rng(8)
    z, fit = [], []
    for _ in range(300):
        found = marker_pose(marker(shot(PRINT, rng=rng)))
        e = np.concatenate(
            [
                R.T @ (T - found.T_world_marker[:3, 3]),
                Rotation.from_matrix(found.T_world_marker[:3, :3].T @ R).as_rotvec(),
            ]
        )
        z.append(e / np.sqrt(np.diagonal(found.covariance)))
        fit.append(found.chi_square)
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(np.ones(6), abs=0.12)
    assert np.mean(fit) == pytest.approx(6, abs=0.6)


def test_three_corners_are_enough_and_two_are_not():
    assert marker_pose(marker(shot(PRINT[:3]), PRINT[:3])).redundancy == 3
    with pytest.raises(CalibrationError, match="2 of its corners were shot, at least three"):
        marker_pose(marker(shot(PRINT[:2]), PRINT[:2]))


def test_corners_on_a_line_are_named():
    line = np.array([[-0.4, 0.3, 0], [0.0, 0.3, 0], [0.4, 0.3, 0]])
    with pytest.raises(CalibrationError, match="lie on one line"):
        marker_pose(marker(shot(line), line))


@pytest.mark.parametrize("p", [PRINT, SQUARE], ids=["oblong", "square"])
@pytest.mark.parametrize("a, b", [(0, 1), (1, 2), (0, 3)])
def test_two_corners_exchanged_are_named_with_the_order_that_fits(p, a, b):
    q = shot(p, rng=np.random.default_rng(1))
    q[[a, b]] = q[[b, a]]
    names = NAMES[a], NAMES[b]
    with pytest.raises(CalibrationError) as error:
        marker_pose(marker(q, p, faces=T + 5 * R[:, 2]))
    assert f"corners {names[0]} and {names[1]} are exchanged" in str(error.value)
    assert f"{names[1]} is {names[0]}, {names[0]} is {names[1]}" in str(error.value)


def test_a_square_print_leaves_two_exchanges_until_it_is_known_from_where_it_is_seen():
    with pytest.raises(CalibrationError, match=r"TL and TR or BR and BL|BR and BL or TL and TR"):
        marker_pose(marker(shot(SQUARE)[[1, 0, 2, 3]], SQUARE))


def test_a_mirrored_order_is_named_where_it_is_known_from_where_the_print_is_seen():
    before = T + 5 * R[:, 2]
    assert marker_pose(marker(shot(SQUARE), SQUARE, faces=before)).redundancy == 6
    with pytest.raises(CalibrationError) as error:
        marker_pose(marker(shot(SQUARE)[[1, 0, 3, 2]], SQUARE, faces=before))
    assert "mirrored order" in str(error.value)
    assert "TR is TL, TL is TR, BL is BR, BR is BL" in str(error.value)
    # A whole survey with its first two columns exchanged is a mirrored one.
    exchanged = shot(SQUARE)[:, [1, 0, 2]]
    with pytest.raises(CalibrationError, match="northing and easting are exchanged"):
        marker_pose(marker(exchanged, SQUARE, faces=before[[1, 0, 2]]))


def test_a_typing_error_is_named_with_its_size():
    q = shot(PRINT, rng=np.random.default_rng(2))
    q[2, 1] += 0.100
    # The shots' own noise is in it: 1 mm a coordinate, some more in the prediction from three.
    with pytest.raises(CalibrationError, match=r"corner BR lies (9[5-9]|10[0-5]) mm from .* northing \+"):
        marker_pose(marker(q))


def test_a_print_of_another_size_is_named():
    with pytest.raises(CalibrationError, match=r"\+2\.0\d % further apart than its print is large"):
        marker_pose(marker(shot(1.02 * PRINT, rng=np.random.default_rng(4))))


def test_what_nothing_explains_is_said():
    q = shot(PRINT)
    q[0] += [0.03, 0.02, -0.03]
    q[1] += [-0.03, 0.03, 0.02]
    q[2] += [0.02, -0.03, 0.03]
    with pytest.raises(
        CalibrationError, match="no order of the corners and no single one of them explains it"
    ):
        marker_pose(marker(q))


def test_markers_together_hold_a_point_better_than_one_and_in_closed_form():
    one = marker_pose(marker(shot(PRINT)))
    # A point five metres before the print is moved by the turn about y (lever 0.4) most.
    assert datum_sigma_m([one], 5.0) == pytest.approx(np.hypot(0.0005, 5 * 0.0005 / 0.3), rel=1e-6)
    assert datum_sigma_m([one, one], 5.0) == pytest.approx(datum_sigma_m([one], 5.0) / np.sqrt(2), rel=1e-6)
