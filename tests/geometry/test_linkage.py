"""The bucket linkage against its own closures, a parallelogram, and central differences."""

import numpy as np
import pytest

from pipeline.geometry import linkage

# Sizes of a 20 t excavator: stick along +x to the bucket pin, linkage above it.
EXAMPLE = np.array([-1.9, 0.45, -0.35, 0.02, 0.55, 0.5, 0.42, 0.9, 0.01])
MIRRORED = EXAMPLE * [1, -1, 1, -1, 1, 1, 1, -1, 1]
SIDES = pytest.mark.parametrize("side, params", [(1, EXAMPLE), (-1, MIRRORED)], ids=["as is", "mirrored"])


def lengths(params, side, margin=0.02, count=301):
    """The stroke without the surroundings of its ends, where the slope is infinite."""
    low, high = linkage.stroke(params, side)
    return np.linspace(low + margin, high - margin, count)


def circles_meet(c1, r1, c2, r2):
    """Both points where two circles meet, by Pythagoras: not the law of cosines that is under test."""
    d = np.hypot(*(c2 - c1))
    along = (r1**2 - r2**2 + d**2) / (2 * d)
    across = np.sqrt(r1**2 - along**2)
    ex = (c2 - c1) / d
    ey = np.array([-ex[1], ex[0]])
    return c1 + along * ex + across * ey, c1 + along * ex - across * ey


@SIDES
def test_one_of_the_assemblies_found_by_intersecting_circles_has_the_angle(side, params):
    A, P, O = params[:2], params[2:4], np.zeros(2)
    for length in lengths(params, side, count=7):
        angles = []
        for E in circles_meet(A, length + params[8], P, params[4]):
            for H in circles_meet(E, params[5], O, params[6]):
                angles.append(np.arctan2(H[1], H[0]) - params[7])
        angle = linkage.bucket_angle(length, params, side)
        assert np.min(np.abs(np.exp(1j * np.array(angles)) - np.exp(1j * angle))) < 1e-13


def test_a_parallelogram_turns_the_horn_with_the_rocker():
    # P-E and O-H equal and parallel: by the law of cosines at the rocker alone, without the coupler.
    params = np.array([-2.0, 0.5, -0.5, 0.0, 0.4, 0.5, 0.4, 0.0, 0.0])
    length = np.array([1.3, 1.5, 1.7])
    anchor = params[:2] - params[2:4]
    d = np.hypot(*anchor)
    rocker = np.arctan2(anchor[1], anchor[0]) - np.arccos((d**2 + 0.4**2 - length**2) / (2 * d * 0.4))
    assert np.allclose(linkage.bucket_angle(length, params), rocker, rtol=0, atol=1e-14)


@SIDES
def test_cylinder_length_undoes_bucket_angle_over_the_whole_stroke(side, params):
    length = lengths(params, side, margin=1e-6)
    angle = linkage.bucket_angle(length, params, side)
    assert np.allclose(linkage.cylinder_length(angle, params, side), length, rtol=0, atol=1e-12)
    assert np.allclose(linkage.cylinder_length(angle + 2 * np.pi, params, side), length, rtol=0, atol=1e-12)


@SIDES
def test_a_longer_cylinder_turns_the_bucket_one_way_only(side, params):
    angle = np.unwrap(linkage.bucket_angle(lengths(params, side, margin=1e-6), params, side))
    assert np.all(np.diff(angle) * side < 0)


@SIDES
def test_outside_the_stroke_there_is_no_angle(side, params):
    low, high = linkage.stroke(params, side)
    assert np.isfinite(linkage.bucket_angle([low + 1e-9, high - 1e-9], params, side)).all()
    assert np.isnan(linkage.bucket_angle([low - 1e-9, high + 1e-9, -1.6, 100.0], params, side)).all()
    assert np.isnan(linkage.bucket_angle_with_jacobians(high + 0.1, params, side)[2]).all()


def test_stroke_ends_at_the_dead_centre_that_comes_first():
    # A long coupler and horn let the rocker turn freely: only cylinder and rocker in line can end it.
    low, high = linkage.stroke(EXAMPLE)
    reach = np.hypot(*(EXAMPLE[:2] - EXAMPLE[2:4]))
    assert high == pytest.approx(reach + EXAMPLE[4] - EXAMPLE[8], rel=1e-12)
    # With a shorter coupler, coupler and horn stretch into a line first: E lies at their sum from O.
    params = EXAMPLE.copy()
    params[5] = 0.35
    E = max(circles_meet(params[2:4], 0.55, np.zeros(2), 0.35 + 0.42), key=lambda point: point[1])
    low, high = linkage.stroke(params)
    assert low == pytest.approx(np.hypot(*(E - params[:2])) - params[8], rel=1e-12)


def test_stroke_is_the_widest_run_of_lengths_that_work_and_the_angle_is_monotone_on_it():
    rng = np.random.default_rng(12)
    scan = np.linspace(0.0, 8.0, 80_001)
    ends = []
    for _ in range(200):
        params = EXAMPLE * rng.uniform(0.25, 2.5, size=9)
        works = np.isfinite(linkage.bucket_angle(scan, params))
        change = np.diff(np.concatenate([[0], works, [0]]))
        starts, stops = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
        low, high = linkage.stroke(params)
        if len(starts) == 0:
            assert not high - low > 1e-4
            continue
        widest = np.argmax(stops - starts)
        assert scan[starts[widest]] == pytest.approx(low, abs=1.01e-4)
        assert scan[stops[widest] - 1] == pytest.approx(high, abs=1.01e-4)
        length = np.linspace(low, high, 2001)[1:-1]
        angle = linkage.bucket_angle(length, params)
        assert np.all(np.diff(np.unwrap(angle)) < 0)
        assert np.allclose(linkage.cylinder_length(angle, params), length, rtol=0, atol=1e-9)
        ends.append((low, high))
    assert len(ends) > 100


def test_an_angle_has_a_length_only_if_that_length_has_the_angle():
    rng = np.random.default_rng(13)
    angle = np.linspace(-np.pi, np.pi, 401)
    for _ in range(200):
        params = EXAMPLE * rng.uniform(0.25, 2.5, size=9)
        length = linkage.cylinder_length(angle, params)
        reached = np.isfinite(length)
        assert not reached.all()
        back = linkage.bucket_angle(length[reached], params)
        assert np.allclose(np.exp(1j * back), np.exp(1j * angle[reached]), rtol=0, atol=1e-9)


def test_bars_that_cannot_meet_have_no_stroke():
    params = EXAMPLE.copy()
    params[5:7] = 0.01
    assert np.isnan(linkage.stroke(params)).all()


@SIDES
def test_linkage_jacobians_match_central_differences(side, params):
    length = lengths(params, side, margin=0.05)
    angle, J_angle_length, J_angle_params = linkage.bucket_angle_with_jacobians(length, params, side)
    assert np.array_equal(angle, linkage.bucket_angle(length, params, side))
    step = 1e-6

    def slope(ahead, behind):
        return np.angle(np.exp(1j * (ahead - behind))) / (2 * step)

    numeric = slope(*(linkage.bucket_angle(length + s * step, params, side) for s in (1, -1)))
    assert np.allclose(J_angle_length, numeric, rtol=1e-6, atol=1e-7)
    for i, d in enumerate(step * np.eye(9)):
        numeric = slope(*(linkage.bucket_angle(length, params + s * d, side) for s in (1, -1)))
        assert np.allclose(J_angle_params[:, i], numeric, rtol=1e-6, atol=1e-7), linkage.PARAMETERS[i]


def test_one_set_of_bars_per_row_gives_what_each_gives():
    many = np.stack([EXAMPLE, EXAMPLE * 1.1])[:, None]
    length = np.array([1.5, 1.6, 1.7])
    angle, J_angle_length, J_angle_params = linkage.bucket_angle_with_jacobians(length, many)
    assert (angle.shape, J_angle_length.shape, J_angle_params.shape) == ((2, 3), (2, 3), (2, 3, 9))
    assert np.allclose(angle[1], linkage.bucket_angle(length, many[1, 0]), rtol=0, atol=1e-15)
    assert np.isscalar(linkage.bucket_angle(1.5, EXAMPLE).item())
