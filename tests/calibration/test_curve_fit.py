"""What is written gives the adjusted angle and its sigma back, and frees nothing twice."""

import numpy as np
import pytest

from pipeline.calibration import bucket, curve_fit
from pipeline.geometry import linkage, se3, so3
from tests.calibration.rigs import drawn

OUTPUTS = pytest.mark.parametrize("output", ["cylinder_m", "angle_deg"])


def adjusted(seed, output="cylinder_m"):
    d = drawn(seed, output)
    return d, bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))


@OUTPUTS
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_file_gives_the_adjusted_angle_and_its_sigma_back(output, seed):
    d, found = adjusted(seed, output)
    kept = curve_fit.written(found)
    told = curve_fit.direction(found, d.nodes(33))
    angle, sigma = curve_fit.of_file(found.rig, kept, d.nodes(33))
    np.testing.assert_allclose(angle, told.angle_rad, atol=np.deg2rad(0.003))
    np.testing.assert_allclose(sigma, told.sigma_rad, rtol=0.02)
    assert curve_fit.monotone(found.rig, kept)
    if output == "cylinder_m":  # the same by the room of geometry alone, with the bars as the file has them
        y = np.polyval(kept.coefficients[::-1], d.nodes(33))
        by_hand = linkage.bucket_angle(y, d.rig.bars, 1) + np.arctan2(*kept.T_bucket_tool[[1, 0], 3])
        np.testing.assert_allclose(angle, by_hand, atol=1e-12)


def test_five_coefficients_at_most_and_no_more_than_needed():
    _, found = adjusted(4, "angle_deg")
    assert len(curve_fit.written(found).coefficients) == 2
    _, found = adjusted(4)
    kept = curve_fit.written(found)
    assert 3 <= len(kept.coefficients) <= 5
    assert kept.misfit_rad < np.deg2rad(0.003) and kept.sigma_off < 0.02


def test_the_covariance_of_the_curve_is_that_of_angles_drawn_from_the_adjustment():
    """Monte Carlo: unknowns drawn from the posterior, the angle of each through the house's linkage, its scatter."""
    d, found = adjusted(5)
    kept = curve_fit.written(found)
    rng = np.random.default_rng(0)
    raw = d.nodes(5)
    root = np.linalg.cholesky(found.covariance + 1e-18 * np.eye(len(found.value)))
    angles = []
    for _ in range(3000):
        x = found.value + root @ rng.standard_normal(len(found.value))
        u = (raw - found.middle) / found.half
        y = np.polyval(x[found.curve][::-1], u)
        T = d.rig.T_bucket_tool @ se3.exp(x[6:12])
        angles.append(linkage.bucket_angle(y, d.rig.bars + x[12:21], 1) + np.arctan2(T[1, 3], T[0, 3]))
    # 3000 draws: 1.3 % of a standard deviation.
    np.testing.assert_allclose(np.std(angles, axis=0), curve_fit.of_file(d.rig, kept, raw)[1], rtol=0.05)


def test_the_edge_keeps_its_direction_in_the_bucket_and_has_no_error_across_it():
    _, found = adjusted(6)
    kept = curve_fit.written(found)
    p = kept.T_bucket_tool[:3, 3]
    assert np.arctan2(p[1], p[0]) == pytest.approx(0.0, abs=1e-12)  # as the file had it
    r, sigma_r, _ = curve_fit.radius_with_jacobian(found)
    assert np.hypot(p[0], p[1]) == pytest.approx(r, abs=1e-12)
    C = kept.T_bucket_tool[:3, :3] @ kept.tool[:3, :3] @ kept.T_bucket_tool[:3, :3].T
    assert np.sqrt(C[0, 0]) == pytest.approx(sigma_r, rel=1e-9)  # along the line from the pin
    assert C[1, 1] < 1e-12 * C[0, 0]  # across it
    turn = so3.log(found.T_bucket_tool()[:3, :3].T @ kept.T_bucket_tool[:3, :3])
    azimuth = np.arctan2(*found.T_bucket_tool()[[1, 0], 3])
    # The teeth turned with the edge, about the bucket's z and nothing else.
    np.testing.assert_allclose(found.T_bucket_tool()[:3, :3] @ turn, [0, 0, -azimuth], atol=1e-12)


def test_azimuth_jacobian_matches_central_differences():
    T = se3.exp(np.array([1.2, 0.3, -0.1, 0.4, -0.9, 0.2]))
    _, J = curve_fit.azimuth_of(T)
    for i in range(6):
        step = 1e-6 * np.eye(6)[i]
        ahead, behind = (curve_fit.azimuth_of(T @ se3.exp(s * step))[0] for s in (1, -1))
        assert J[i] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


def test_readings_a_little_beyond_are_used_and_said_to_be_beyond():
    d, found = adjusted(7)
    kept = curve_fit.written(found)
    raw = [s.raw for s in d.stands]
    assert kept.stroke == (min(raw), max(raw))
    span = max(raw) - min(raw)
    np.testing.assert_allclose(kept.raw_range, (min(raw) - 0.08 * span, max(raw) + 0.08 * span))
