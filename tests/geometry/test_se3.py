"""Poses against the matrix exponential, SciPy's rigid transforms, central differences and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial import transform as scipy_transform

from pipeline.geometry import se3, so3

# Around 0, around the change-over from series to closed form at 2 rad, and up to pi.
ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.01, 0.5, 1.999999, 2.000001, 3.0, np.pi - 1e-9]
ROUNDING = 3e-14  # 6x6 products of numbers of order three, a few in a row

twists = arrays(np.float64, 6, elements=st.floats(-1.8, 1.8))  # |phi| < pi
repeatable = settings(derandomize=True, deadline=None)


def twists_of_angle(angle, count=30):
    rho, axes = np.random.default_rng(3).normal(size=(2, count, 3))
    return np.hstack([rho, angle * axes / np.linalg.norm(axes, axis=-1, keepdims=True)])


def matrix_of(xi):
    """The 4x4 matrix of a twist, whose matrix exponential is the pose."""
    X = np.zeros((*xi.shape[:-1], 4, 4))
    X[..., :3, :3], X[..., :3, 3] = so3.hat(xi[..., 3:]), xi[..., :3]
    return X


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential_and_log_its_inverse(angle):
    xi = twists_of_angle(angle)
    T = expm(matrix_of(xi))
    assert np.allclose(se3.exp(xi), T, rtol=0, atol=ROUNDING)
    assert np.allclose(se3.log(T), xi, rtol=0, atol=ROUNDING)


@repeatable
@given(twists, twists)
def test_poses_form_a_group(a, b):
    T_world_a, T_a_b = se3.exp(a), se3.exp(b)
    assert np.allclose(T_world_a @ se3.inverse(T_world_a), np.eye(4), atol=ROUNDING)
    assert np.allclose(se3.retract(T_world_a, b), T_world_a @ T_a_b, atol=ROUNDING)
    assert np.allclose(se3.retract(T_world_a, se3.local(T_world_a, T_a_b)), T_a_b, atol=ROUNDING)
    p_b = np.array([0.3, -2.0, 1.1])
    in_two_steps = se3.transform(T_world_a, se3.transform(T_a_b, p_b))
    assert np.allclose(se3.transform(T_world_a @ T_a_b, p_b), in_two_steps, atol=ROUNDING)


@repeatable
@given(twists, twists)
def test_adjoint_carries_an_error_across_a_pose(xi, pose):
    T = se3.exp(pose)
    assert np.allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(se3.Ad(T) @ xi), atol=10 * ROUNDING)
    assert np.allclose(se3.Ad(T), expm(se3.ad(pose)), atol=10 * ROUNDING)
    assert np.allclose(se3.ad(xi) @ pose, -se3.ad(pose) @ xi, atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_integral_of_the_exponential(angle):
    # expm([[X, I], [0, 0]]) holds the integral of exp(tau X) over [0, 1] in its upper right block: Jl.
    for xi in twists_of_angle(angle, count=5):
        augmented = np.zeros((12, 12))
        augmented[:6, :6], augmented[:6, 6:] = se3.ad(xi), np.eye(6)
        assert np.allclose(se3.Jl(xi), expm(augmented)[:6, 6:], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_inverse_jacobians_are_inverses(angle):
    xi = twists_of_angle(angle)
    assert np.allclose(se3.Jl(xi) @ se3.Jl_inv(xi), np.eye(6), rtol=0, atol=ROUNDING)
    assert np.allclose(se3.Jr(xi) @ se3.Jr_inv(xi), np.eye(6), rtol=0, atol=ROUNDING)


def test_right_jacobian_is_the_one_on_the_right():
    xi, d = twists_of_angle(1.3), 1e-6 * twists_of_angle(1.0)[::-1]
    by_right = se3.exp(xi) @ se3.exp(np.einsum("nij,nj->ni", se3.Jr(xi), d))
    by_left = se3.exp(np.einsum("nij,nj->ni", se3.Jl(xi), d)) @ se3.exp(xi)
    assert np.allclose(se3.exp(xi + d), by_right, rtol=0, atol=3e-11)  # second order in d
    assert np.allclose(se3.exp(xi + d), by_left, rtol=0, atol=3e-11)


@pytest.mark.parametrize("angle", ANGLES)
def test_derivative_of_the_inverse_jacobian_matches_central_differences(angle):
    xi = twists_of_angle(angle)
    w = np.random.default_rng(8).normal(size=xi.shape)
    step = 1e-5
    columns = []
    for d in step * np.eye(6):
        ahead, behind = (np.einsum("nij,nj->ni", se3.Jr_inv(at), w) for at in (xi + d, xi - d))
        columns.append((ahead - behind) / (2 * step))
    # Truncation is step² and rounding 1e-15 / step: both about 1e-10.
    J = se3.jr_inv_times_derivative(xi, w)
    assert np.allclose(J, np.stack(columns, axis=-1), rtol=0, atol=1e-9)


def test_derivative_of_the_inverse_jacobian_broadcasts_one_velocity_over_many_steps():
    xi, w = twists_of_angle(0.4), np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.3])
    J = se3.jr_inv_times_derivative(xi, w)
    assert J.shape == (30, 6, 6)
    assert np.array_equal(J[7], se3.jr_inv_times_derivative(xi[7], w))


def test_derivative_has_no_step_where_series_and_closed_form_meet():
    w = np.random.default_rng(5).normal(size=(30, 6))
    below, above = (se3.jr_inv_times_derivative(twists_of_angle(2.0 + d), w) for d in (-1e-13, 1e-13))
    assert np.allclose(below, above, rtol=0, atol=1e-11)


def test_grid_covariance_predicts_the_scatter_of_perturbed_poses():
    rng = np.random.default_rng(11)
    T_world_body = se3.exp(np.array([120.0, -40.0, 7.0, 0.4, -0.9, 1.2]))
    A = 0.003 * rng.normal(size=(6, 6))
    cov_xi = A @ A.T
    xi = rng.multivariate_normal(np.zeros(6), cov_xi, size=40_000)
    T = se3.retract(T_world_body, xi)
    position = T[:, :3, 3] - T_world_body[:3, 3]
    # A rotation vector about the grid axes turns the estimate into the truth from the left.
    rotation = so3.log(T[:, :3, :3] @ T_world_body[:3, :3].T)
    scatter = np.cov(np.hstack([position, rotation]).T)
    cov_grid = se3.to_grid_covariance(T_world_body, cov_xi)
    sigma = np.sqrt(np.diag(cov_grid))
    # A sampled correlation is good to 1 / sqrt(40,000) = 0.005, a variance to 0.007.
    assert np.allclose(scatter / np.outer(sigma, sigma), cov_grid / np.outer(sigma, sigma), atol=0.03)
    assert np.allclose(se3.from_grid_covariance(T_world_body, cov_grid), cov_xi, rtol=0, atol=1e-18)


@pytest.mark.skipif(not hasattr(scipy_transform, "RigidTransform"), reason="SciPy before 1.16")
def test_swap_speaks_to_scipy_which_puts_rotation_first():
    xi = twists_of_angle(1.1)
    theirs = scipy_transform.RigidTransform.from_exp_coords(se3.swap_rotation_first(xi)).as_matrix()
    assert np.allclose(se3.exp(xi), theirs, atol=ROUNDING)


def test_swapped_covariance_is_that_of_the_swapped_twist():
    sigma = np.arange(1.0, 7.0)
    cov = np.outer(sigma, sigma)
    swapped = se3.swap_rotation_first(cov, axes=(-2, -1))
    assert np.array_equal(np.diag(swapped), [16.0, 25.0, 36.0, 1.0, 4.0, 9.0])
    assert np.array_equal(se3.swap_rotation_first(swapped, axes=(-2, -1)), cov)


def test_poses_keep_the_leading_axes():
    xi = np.random.default_rng(2).normal(size=(2, 5, 6))
    T = se3.exp(xi)
    assert T.shape == (2, 5, 4, 4)
    assert np.array_equal(T[..., 3, :], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (2, 5, 4)))
    for f in (se3.Jl, se3.Jr, se3.Jl_inv, se3.Jr_inv, se3.ad):
        assert np.array_equal(f(xi)[1, 3], f(xi[1, 3]))
    assert np.array_equal(se3.Ad(T)[1, 3], se3.Ad(T[1, 3]))
    assert np.array_equal(se3.log(T)[1, 3], se3.log(T[1, 3]))
    p = np.array([1.0, 2.0, 3.0])
    assert np.allclose(se3.transform(T, p)[1, 3], (T[1, 3] @ [1.0, 2.0, 3.0, 1.0])[:3], atol=ROUNDING)
    R, t = T[..., :3, :3], T[..., :3, 3]
    assert np.array_equal(se3.from_rotation_translation(R, t), T)
    assert np.array_equal(se3.identity((2, 5)) @ T, T)
