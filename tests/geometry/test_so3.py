"""Rotations against SciPy's rotations, the matrix exponential, and central differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pipeline.geometry import so3

# Around 0, around the change-over from series to closed form at 2 rad, and up to pi.
ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.01, 0.5, 1.999999, 2.000001, 3.0, np.pi - 1e-6, np.pi - 1e-9]
ROUNDING = 5e-15  # a dozen operations on numbers of order one

vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))  # |phi| < pi
repeatable = settings(derandomize=True, deadline=None)


def of_length(angle, count=40):
    axes = np.random.default_rng(3).normal(size=(count, 3))
    return angle * axes / np.linalg.norm(axes, axis=-1, keepdims=True)


def test_hat_is_the_cross_product_and_vee_undoes_it():
    a, b = np.random.default_rng(0).normal(size=(2, 7, 3))
    assert np.allclose(np.einsum("nij,nj->ni", so3.hat(a), b), np.cross(a, b), atol=ROUNDING)
    assert np.array_equal(so3.vee(so3.hat(a)), a)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    phi = of_length(angle)
    assert np.allclose(so3.exp(phi), expm(so3.hat(phi)), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_returns_every_digit_at_zero_and_near_pi(angle):
    phi = of_length(angle)
    assert np.allclose(so3.log(so3.exp(phi)), phi, rtol=4e-15, atol=1e-300)


def test_log_at_exactly_pi_is_a_half_turn_about_the_right_axis():
    axes = np.vstack([np.eye(3), of_length(1.0)])
    half_turns = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    phi = so3.log(half_turns)
    assert np.allclose(np.linalg.norm(phi, axis=-1), np.pi, atol=ROUNDING)
    assert np.allclose(np.abs(np.einsum("ni,ni->n", phi, axes)), np.pi, atol=ROUNDING)


@repeatable
@given(vectors)
def test_exp_and_log_agree_with_scipy(phi):
    R = Rotation.from_rotvec(phi).as_matrix()
    assert np.allclose(so3.exp(phi), R, atol=ROUNDING)
    assert np.allclose(so3.log(R), Rotation.from_matrix(R).as_rotvec(), atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_integral_of_the_exponential(angle):
    # expm([[W, I], [0, 0]]) holds the integral of exp(tau W) over [0, 1] in its upper right block: Jl.
    for phi in of_length(angle, count=5):
        augmented = np.zeros((6, 6))
        augmented[:3, :3], augmented[:3, 3:] = so3.hat(phi), np.eye(3)
        assert np.allclose(so3.Jl(phi), expm(augmented)[:3, 3:], rtol=0, atol=2e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_inverse_jacobians_are_inverses(angle):
    phi = of_length(angle)
    assert np.allclose(so3.Jl(phi) @ so3.Jl_inv(phi), np.eye(3), rtol=0, atol=ROUNDING)
    assert np.allclose(so3.Jr(phi) @ so3.Jr_inv(phi), np.eye(3), rtol=0, atol=ROUNDING)


def test_right_jacobian_is_the_one_on_the_right():
    phi, d = of_length(1.3), 1e-6 * of_length(1.0)[::-1]
    moved = so3.exp(phi) @ so3.exp(np.einsum("nij,nj->ni", so3.Jr(phi), d))
    assert np.allclose(so3.exp(phi + d), moved, rtol=0, atol=2e-12)  # second order in d
    moved = so3.exp(np.einsum("nij,nj->ni", so3.Jl(phi), d)) @ so3.exp(phi)
    assert np.allclose(so3.exp(phi + d), moved, rtol=0, atol=2e-12)


def test_roll_pitch_yaw_are_scipys_extrinsic_xyz():
    rpy_deg = np.random.default_rng(1).uniform([-180, -90, -180], [180, 90, 180], size=(200, 3))
    R = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()
    assert np.allclose(so3.from_rpy_deg(rpy_deg), R, atol=ROUNDING)
    assert np.allclose(so3.to_rpy_deg(R), rpy_deg, atol=1e-9)  # 1 / cos(pitch) times rounding


@pytest.mark.parametrize("pitch_deg", [90.0, -90.0, 90.0 - 1e-10, -90.0 + 1e-7])
def test_roll_pitch_yaw_give_the_rotation_back_in_gimbal_lock(pitch_deg):
    R = so3.from_rpy_deg([[25.0, pitch_deg, -70.0], [-170.0, pitch_deg, 30.0]])
    assert np.allclose(so3.from_rpy_deg(so3.to_rpy_deg(R)), R, rtol=0, atol=ROUNDING)


def test_roll_survives_a_pitch_of_exactly_ninety_degrees():
    # All four elements from which roll and yaw are usually read are exact zeros.
    c, s = np.cos(0.3), np.sin(0.3)
    R = np.array([[0, s, c], [0, c, -s], [-1, 0, 0]])
    assert np.allclose(so3.to_rpy_deg(R), [np.rad2deg(0.3), 90.0, 0.0], rtol=0, atol=1e-12)


@repeatable
@given(vectors)
def test_quaternion_is_scipys_with_the_scalar_last_and_not_negative(phi):
    R = so3.exp(phi)
    q = so3.to_quaternion(R)
    assert q[3] >= 0
    assert np.allclose(q, Rotation.from_matrix(R).as_quat(canonical=True), atol=ROUNDING)
    assert np.allclose(so3.from_quaternion(-3.0 * q), R, atol=ROUNDING)


def test_rotations_keep_the_leading_axes():
    phi = np.random.default_rng(2).normal(size=(2, 5, 3))
    for f in (so3.exp, so3.Jl, so3.Jr_inv):
        assert f(phi).shape == (2, 5, 3, 3)
        assert np.array_equal(f(phi)[1, 3], f(phi[1, 3]))
    assert so3.log(so3.exp(phi)).shape == (2, 5, 3)
    assert so3.to_quaternion(so3.exp(phi)).shape == (2, 5, 4)
