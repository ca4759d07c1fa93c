"""An axis from motion: a drawn truth, its scatter, and the motion that does not suffice."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.calibration.axes import TOLD, axis_of_motion
from pipeline.errors import CalibrationError

SIGMA = np.repeat([2e-3, 3e-3], 3)
COVARIANCE = np.diag(SIGMA**2)


def pose(rotvec, t):
    """Not by the house's own se3: SciPy is the oracle."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = t
    return T


AXIS, MARKER = pose([0.4, -0.3, 0.8], [0.3, 0.2, 0.1]), pose([1.0, -0.5, 0.3], [0.5, -0.3, 0.7])


def poses(angles, rng=None):
    T = np.array([AXIS @ pose([0, 0, a], [0, 0, 0]) @ MARKER for a in angles])
    if rng is not None:
        T = np.array(
            [t @ pose(e[3:], e[:3]) for t, e in zip(T, rng.normal(size=(len(T), 6)) * SIGMA, strict=True)]
        )
    return T


def off(found):
    """x, y of where the true line pierces the found axis's plane, and its tilt about x and y."""
    D = np.linalg.inv(found.T_parent_axis) @ AXIS
    d, p = D[:3, 2], D[:3, 3]
    p = p - d * p[2] / d[2]
    return np.array([p[0], p[1], -d[1], d[0]])


def test_without_noise_the_line_is_found_from_a_poor_start():
    angles = np.linspace(-0.8, 0.9, 12)
    said = AXIS @ pose([0.15, -0.2, 0.3], [0.05, -0.08, 0.02])
    found = axis_of_motion(poses(angles), np.tile(COVARIANCE, (12, 1, 1)), said, "bucket")
    assert np.abs(off(found)).max() < 1e-9
    assert found.turn_rad == pytest.approx(1.7)
    assert np.diff(found.angle_rad) == pytest.approx(np.diff(angles), abs=1e-9)
    # The origin is the point of the line nearest to the file's, and x leans as little from the file's as it can.
    foot = found.T_parent_axis[:3, 3] - said[:3, 3]
    assert foot @ AXIS[:3, 2] == pytest.approx(0, abs=1e-9)
    assert found.T_parent_axis[:3, 1] @ said[:3, 0] == pytest.approx(0, abs=1e-9)
    assert found.circle_m < 1e-9 and found.plane_m < 1e-9


def test_the_axis_points_the_way_the_file_says():
    angles = np.linspace(-0.5, 0.5, 8)
    turned = AXIS @ pose([np.pi, 0, 0], [0, 0, 0])
    found = axis_of_motion(poses(angles), np.tile(COVARIANCE, (8, 1, 1)), turned, "bucket")
    assert found.T_parent_axis[:3, 2] == pytest.approx(-AXIS[:3, 2], abs=1e-9)
    assert np.all(np.diff(found.angle_rad) < 0)


def test_the_covariance_predicts_the_scatter_of_150_noisy_logs():
    rng = np.random.default_rng(5)
    lengths, fit, z = [], [], []
    for _ in range(150):
        found = axis_of_motion(
            poses(rng.uniform(-0.9, 0.9, 20), rng), np.tile(COVARIANCE, (20, 1, 1)), AXIS, "bucket"
        )
        e = off(found)
        lengths.append(e @ np.linalg.solve(found.covariance, e))
        z.append(e / np.sqrt(np.diagonal(found.covariance)))
        fit.append(found.chi_square / found.redundancy)
    # Mean of 150 chi-squares of 4 degrees of freedom: sigma 0.23.
    assert 3.3 < np.mean(lengths) < 4.7
    assert np.all((np.std(z, axis=0) > 0.8) & (np.std(z, axis=0) < 1.2))
    assert 0.95 < np.mean(fit) < 1.05
    assert len(TOLD) == 4


def test_what_a_marker_is_off_its_circle_and_its_plane_is_told_apart():
    T = poses(np.linspace(-0.8, 0.8, 30))
    across = AXIS[:3, 2]
    T[:, :3, 3] += np.where(np.arange(30) % 2, 1, -1)[:, None] * 0.004 * across
    found = axis_of_motion(T, np.tile(COVARIANCE, (30, 1, 1)), AXIS, "bucket")
    assert found.plane_m == pytest.approx(0.004, rel=0.1)
    assert found.circle_m < 0.0008


@pytest.mark.parametrize("turn_deg, refused", [(8, True), (18, True), (23, False)])
def test_a_joint_that_hardly_turned_is_named(turn_deg, refused):
    T = poses(np.deg2rad(np.linspace(0, turn_deg, 10)))
    if not refused:
        axis_of_motion(T, np.tile(COVARIANCE, (10, 1, 1)), AXIS, "bucket")
        return
    with pytest.raises(CalibrationError, match=rf"joint 'bucket' turned by {turn_deg}.0 degrees only"):
        axis_of_motion(T, np.tile(COVARIANCE, (10, 1, 1)), AXIS, "bucket")


def test_too_few_poses_are_named():
    with pytest.raises(CalibrationError, match="seen together 3 times"):
        axis_of_motion(poses([0, 0.4, 0.8]), np.tile(COVARIANCE, (3, 1, 1)), AXIS, "bucket")
