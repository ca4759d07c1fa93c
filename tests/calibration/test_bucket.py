"""Curve, tool and pin from touches: drawn truth, closed forms, central differences."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibration import bucket, curve_fit
from pipeline.calibration.touches import BARS, TOOL, powers_of_raw
from tests.calibration.rigs import drawn

OUTPUTS = pytest.mark.parametrize("output", ["cylinder_m", "angle_deg"])


def adjusted(d):
    return bucket.adjust(d.rig, d.stands, d.touches, list(d.points.values()))


@OUTPUTS
def test_without_errors_the_truth_comes_back(output):
    d = drawn(3, output, scale=0.0)
    found = adjusted(d)
    told = curve_fit.direction(found, d.nodes())
    # The priors' means are the truth, so nothing pulls; what is left is the nearly flat prior of the curve.
    np.testing.assert_allclose(told.angle_rad, d.direction(d.nodes()), atol=2e-6)
    assert curve_fit.radius_with_jacobian(found)[0] == pytest.approx(1.25, abs=1e-6)
    assert np.abs(found.residual).max() < 1e-5


@OUTPUTS
def test_errors_are_as_large_as_their_sigmas_say(output):
    z, z_radius, chi = [], [], []
    for seed in range(1000, 1060):
        d = drawn(seed, output)
        found = adjusted(d)
        told = curve_fit.direction(found, d.nodes())
        z.append((told.angle_rad - d.direction(d.nodes())) / told.sigma_rad)
        r, sigma_r, _ = curve_fit.radius_with_jacobian(found)
        z_radius.append((r - d.radius) / sigma_r)
        statistic, redundancy = found.chi_square()
        chi.append(statistic / redundancy)
    # 60 rigs with some three independent directions each: 1 +- 0.05 for angles, 1 +- 0.09 for radii.
    assert 0.85 < np.sqrt(np.mean(np.square(z))) < 1.15
    assert 0.75 < np.sqrt(np.mean(np.square(z_radius))) < 1.25
    assert 0.9 < np.mean(chi) < 1.1  # redundancy 21 or 22: 1 +- 0.04


@OUTPUTS
@pytest.mark.parametrize("edge_point", ["left", "middle"])
def test_the_jacobian_matches_central_differences(output, edge_point):
    d = drawn(5, output, edge_point=edge_point)
    found = adjusted(d)
    _, J, _ = bucket.linearised(found, found.value)
    for i in range(len(found.value)):
        step = np.zeros(len(found.value))
        step[i] = 1e-6
        ahead, behind = (bucket.linearised(found, found.value + s * step)[0] for s in (1, -1))
        # Residuals are given minus adjusted.
        np.testing.assert_allclose(J[:, i], (behind - ahead) / 2e-6, atol=3e-6)


def test_the_distance_from_pin_to_edge_is_the_mean_distance_of_the_touches():
    """Poses, pin and point exact, the tool free: least squares is then the mean, sigma the contact's over root n."""
    d = drawn(8, "angle_deg")
    d.rig = replace(d.rig, axis=np.zeros((6, 6)), tool=np.diag([1.0] * 3 + [0.0] * 3))
    d.stands = [replace(s, own=np.zeros((6, 6)), factors=np.zeros((6, 0)), raw_sigma=0.0) for s in d.stands]
    d.points = {"TP1": 0.0}
    in_axis = [
        np.linalg.solve(s.T_world_axis, np.append(t.p_world, 1.0)) for s, t in zip(d.stands, d.touches)
    ]
    distances = [np.hypot(p[0], p[1]) for p in in_axis]
    r, sigma_r, _ = curve_fit.radius_with_jacobian(adjusted(d))
    # To second order: a tangential misfit of 2 mm moves a distance by 1.6 um.
    assert r == pytest.approx(np.mean(distances), abs=2e-5)
    assert sigma_r == pytest.approx(0.001 / np.sqrt(8), rel=1e-3)


def test_a_touch_by_any_part_of_the_edge_says_nothing_along_it():
    d = drawn(4)
    d.touches = [replace(t, edge_point="") for t in d.touches]
    before = adjusted(d)
    k = 3
    along = (d.stands[k].T_world_axis @ d.rig.T_bucket_tool)[:3, 0]  # the pin's direction, whatever the angle
    moved = [replace(t, p_world=t.p_world + 0.05 * along) if i == k else t for i, t in enumerate(d.touches)]
    d.touches = moved
    after = adjusted(d)
    raw = d.nodes()
    shift = curve_fit.direction(after, raw).angle_rad - curve_fit.direction(before, raw).angle_rad
    assert np.abs(shift).max() < np.deg2rad(0.01)
    sideways = [np.sqrt(a.covariance[TOOL, TOOL][0, 0]) for a in (before, adjusted(drawn(4)))]
    assert sideways[0] == pytest.approx(0.001, rel=0.02)  # its prior
    assert sideways[1] < 0.97 * 0.001


def test_left_and_right_teeth_tell_how_the_edge_lies():
    """A shot of each end at every stand: the edge's direction is then known to its shots, not to its prior."""
    d = drawn(6, scale=0.0)
    d.rig = replace(d.rig, tool=np.diag([1e-3] * 3 + [np.deg2rad(3.0)] * 3) ** 2)
    tilt = np.deg2rad(1.0)
    touches = []
    for k, (stand, touch) in enumerate(zip(d.stands, d.touches)):
        middle = touch.p_world
        x = stand.T_world_axis[:3, 2] * np.cos(
            tilt
        )  # along the pin, turned by a degree in the bucket's plane
        bucket_y = d.rig.T_bucket_tool[:3, 1]
        angle = d.direction([stand.raw])[0]
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        x = x + np.sin(tilt) * (stand.T_world_axis[:3, :3] @ turn @ bucket_y)
        for name, side in (("left", -0.5), ("right", 0.5)):
            touches.append(replace(touch, stand=k, p_world=middle + side * x, point=-1, edge_point=name))
    d.touches = touches
    found = adjusted(d)
    about_z = np.sqrt(found.covariance[TOOL, TOOL][5, 5])
    assert found.value[TOOL][5] == pytest.approx(tilt, abs=3 * about_z)
    assert abs(found.value[TOOL][4]) < 3 * np.sqrt(found.covariance[TOOL, TOOL][4, 4])
    assert about_z < np.deg2rad(0.1)


def test_touches_of_one_stand_share_its_pose():
    """Three shots of one parked edge say hardly more of the angle than one: the pose's own error is the same in all."""
    d = drawn(7)
    one = adjusted(d)
    d.touches = [replace(t, name=f"{t.name} {i}") for t in d.touches for i in range(3)]
    three = adjusted(d)
    raw = d.nodes()
    ratio = curve_fit.direction(three, raw).sigma_rad / curve_fit.direction(one, raw).sigma_rad
    assert np.all(ratio > 0.85) and np.all(ratio < 1.0)


def test_what_all_stands_share_does_not_average_out():
    d = drawn(2)
    lift = np.zeros((6, 1))
    lift[4] = np.deg2rad(0.2)  # a turn of every pose about the pin
    d.stands = [
        replace(s, factors=np.vstack([np.zeros((3, 1)), s.T_world_axis[:3, 2:3] * lift[4]])) for s in d.stands
    ]
    sigma = curve_fit.direction(adjusted(d), d.nodes()).sigma_rad
    assert np.all(sigma > 0.85 * np.deg2rad(0.2)), np.rad2deg(sigma)


def test_a_known_curve_is_held_and_the_teeth_give_way():
    """Wear: the curve exact, 12 mm of the teeth gone along the tool's z."""
    d = drawn(9, scale=0.0)
    worn = drawn(9, scale=0.0)
    back = np.eye(4)
    back[2, 3] = -0.012
    edge_moves = []
    for stand in d.stands:
        angle = d.direction([stand.raw])[0]
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        T = stand.T_world_axis @ turn @ d.rig.T_bucket_tool
        edge_moves.append((T @ back)[:3, 3] - T[:3, 3])
    worn.touches = [replace(t, p_world=t.p_world + move) for t, move in zip(d.touches, edge_moves)]
    tool = d.rig.tool.copy()
    tool[2, 2] += 0.2**2
    worn.rig = replace(d.rig, tool=tool, curve=(d.curve, np.zeros((3, 3))))
    found = adjusted(worn)
    sigma = float(np.sqrt(found.covariance[TOOL, TOOL][2, 2]))
    assert -found.value[TOOL][2] == pytest.approx(0.012, abs=0.3 * sigma)
    assert sigma < 0.004
    np.testing.assert_array_equal(found.value[found.curve], powers_to_u(found, d.curve))


def powers_to_u(found, curve):
    return np.linalg.inv(powers_of_raw(len(curve), found.middle, found.half)) @ curve


def test_powers_of_u_and_of_the_reading_are_the_same_polynomial():
    c, raw = np.array([0.3, -1.2, 0.4, 2.0]), np.linspace(0.5, 4.5, 7)
    in_raw = powers_of_raw(4, 2.5, 1.7) @ c
    u = (raw - 2.5) / 1.7
    np.testing.assert_allclose(np.polyval(in_raw[::-1], raw), np.polyval(c[::-1], u), atol=1e-13)


def test_exact_bars_stay_exact():
    d = drawn(1)
    d.rig = replace(d.rig, bars_covariance=np.zeros((9, 9)))
    found = adjusted(d)
    np.testing.assert_array_equal(found.value[BARS], 0.0)
    assert np.all(found.covariance[BARS] == 0)


def test_bars_that_cannot_reach_are_refused():
    d = drawn(1)
    long = d.rig.bars.copy()
    long[5] = 3.0  # the coupler
    d.rig = replace(d.rig, bars=long)
    with pytest.raises(FloatingPointError):
        adjusted(d)
