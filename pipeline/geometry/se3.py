"""Poses: exponential, logarithm, adjoints, Jacobians, and the step from our pose error to the published one.

``T_target_source`` is ``(..., 4, 4)``. The error of a pose is ``xi = [rho, phi]``, metres and radians,
translation first, applied on the right: ``T @ exp(xi)``. Everything is batched over leading axes.

The matrix ``ad(xi)`` satisfies ``X (X² + |phi|²)² = 0``, so each analytic function of it is a polynomial of
degree four. That gives the Jacobians, their inverses and the derivative of those in one stroke and to
machine precision; the Q matrix of Barfoot (State Estimation for Robotics, eq. 7.86) is their upper right
block. Cutting the Bernoulli series of the inverse at ``X^6`` is good to 1e-10 only below 0.4 rad.
"""

import numpy as np

from pipeline.geometry import so3

_K = np.arange(len(so3.COT))


def from_rotation_translation(R, t):
    """Pose matrix of a rotation matrix (..., 3, 3) and a translation (..., 3) in metres: (..., 4, 4)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros(batch + (4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def identity(batch=()):
    """Identity poses of the given leading shape: (*batch, 4, 4)."""
    return np.broadcast_to(np.eye(4), tuple(batch) + (4, 4)).copy()


def inverse(T):
    """``T_source_target`` of ``T_target_source``: (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rotation_translation(R_t, -np.einsum("...ij,...j->...i", R_t, T[..., :3, 3]))


def transform(T, p):
    """Points in the target frame: ``p_target = T_target_source @ p_source``.

    Parameters
    ----------
    T : (..., 4, 4) array
        ``T_target_source``.
    p : (..., 3) array
        Metres; leading axes broadcast against those of ``T``.

    Returns
    -------
    (..., 3) array
        Metres.
    """
    T = np.asarray(T, dtype=np.float64)
    return np.einsum("...ij,...j->...i", T[..., :3, :3], p) + T[..., :3, 3]


def exp(xi):
    """Pose of a twist ``xi = [rho, phi]``.

    Parameters
    ----------
    xi : (..., 6) array
        Metres and radians.

    Returns
    -------
    (..., 4, 4) array
    """
    rho, phi = _split(xi)
    return from_rotation_translation(so3.exp(phi), np.einsum("...ij,...j->...i", so3.Jl(phi), rho))


def log(T):
    """Twist ``xi = [rho, phi]`` of a pose, with ``|phi| <= pi``: (..., 6), metres and radians."""
    T = np.asarray(T, dtype=np.float64)
    phi = so3.log(T[..., :3, :3])
    rho = np.einsum("...ij,...j->...i", so3.Jl_inv(phi), T[..., :3, 3])
    return np.concatenate([rho, phi], axis=-1)


def retract(T, xi):
    """The pose moved by an error in its own frame: ``T @ exp(xi)``, (..., 4, 4)."""
    return np.asarray(T, dtype=np.float64) @ exp(xi)


def local(T, T_other):
    """The error that leads from one pose to another: ``log(inverse(T) @ T_other)``, (..., 6).

    ``retract(T, local(T, T_other)) = T_other``.
    """
    return log(inverse(T) @ np.asarray(T_other, dtype=np.float64))


def Ad(T):
    """Adjoint: ``T @ exp(xi) = exp(Ad(T) xi) @ T``.

    With ``T_a_b``, takes an error felt in frame ``b`` to the same error felt in frame ``a``.

    Parameters
    ----------
    T : (..., 4, 4) array
        ``T_a_b``.

    Returns
    -------
    (..., 6, 6) array
    """
    T = np.asarray(T, dtype=np.float64)
    R, t = T[..., :3, :3], T[..., :3, 3]
    return _blocks(R, so3.hat(t) @ R)


def ad(xi):
    """Small adjoint, the Lie bracket of twists: (..., 6, 6).

    ``ad(a) b = -ad(b) a``, and ``Ad(exp(xi))`` is the matrix exponential of ``ad(xi)``.
    """
    rho, phi = _split(xi)
    return _blocks(so3.hat(phi), so3.hat(rho))


def Jl(xi):
    """Left Jacobian: ``exp(xi + d) = exp(Jl(xi) d) @ exp(xi)`` to first order in ``d``.

    Parameters
    ----------
    xi : (..., 6) array
        Metres and radians.

    Returns
    -------
    (..., 6, 6) array
    """
    X = ad(xi)
    s = _squared_angle(xi)
    X2 = X @ X
    odd = np.stack(_odd_coefficients(s))[..., None, None]
    even = np.stack(_even_coefficients(s))[..., None, None]
    return np.eye(6) + odd[0] * X + even[0] * X2 + (odd[1] * X + even[1] * X2) @ X2


def Jr(xi):
    """Right Jacobian: ``exp(xi + d) = exp(xi) @ exp(Jr(xi) d)`` to first order in ``d``; (..., 6, 6)."""
    return Jl(-np.asarray(xi, dtype=np.float64))


def Jl_inv(xi):
    """Inverse of ``Jl``; singular at ``|phi| = 2 pi``; (..., 6, 6)."""
    return Jr_inv(-np.asarray(xi, dtype=np.float64))


def Jr_inv(xi):
    """Inverse of ``Jr``: how ``log(exp(xi) @ exp(d))`` moves with a small ``d``.

    Parameters
    ----------
    xi : (..., 6) array
        Metres and radians, ``|phi| < 2 pi``.

    Returns
    -------
    (..., 6, 6) array
    """
    X = ad(xi)
    c2, c4 = (c[..., None, None] for c in _inverse_coefficients(_squared_angle(xi)))
    X2 = X @ X
    return np.eye(6) + 0.5 * X + c2 * X2 + c4 * (X2 @ X2)


def jr_inv_times_derivative(xi, w):
    """Derivative of ``Jr_inv(xi) w`` with respect to ``xi``, for a fixed ``w``.

    The white-noise-on-acceleration prior compares the velocities at two epochs in the frame of the first,
    ``Jr_inv(xi) w_2 - w_1`` with ``xi = local(T_1, T_2)``; this is its Jacobian in ``xi``. With
    ``Jr_inv = I + X/2 + c2 X² + c4 X⁴`` it collects ``d(X u) = -ad(u) dxi + X du`` for each power, and the
    change of ``c2`` and ``c4`` with ``s = |phi|²``.

    Parameters
    ----------
    xi : (..., 6) array
        Metres and radians, ``|phi| < 2 pi``.
    w : (..., 6) array
        Any twist, as a rule m/s and rad/s.

    Returns
    -------
    (..., 6, 6) array
        Row: component of ``Jr_inv(xi) w``; column: component of ``xi``.
    """
    xi, w = np.broadcast_arrays(np.asarray(xi, dtype=np.float64), np.asarray(w, dtype=np.float64))
    X = ad(xi)
    s = _squared_angle(xi)
    c2, c4 = _inverse_coefficients(s)
    dc2, dc4 = _inverse_coefficient_slopes(s)
    power, J_power = [w], [np.zeros_like(X)]  # X^n w and its derivative in xi
    for n in range(4):
        J_power.append(X @ J_power[n] - ad(power[n]))
        power.append(np.einsum("...ij,...j->...i", X, power[n]))
    J = 0.5 * J_power[1] + c2[..., None, None] * J_power[2] + c4[..., None, None] * J_power[4]
    slope = dc2[..., None] * power[2] + dc4[..., None] * power[4]
    J[..., :, 3:] += 2 * slope[..., :, None] * xi[..., None, 3:]
    return J


def to_grid_covariance(T_world_body, cov_xi):
    """Published covariance of a pose: position and rotation vector along the grid axes.

    To first order the position of ``T @ exp(xi)`` is off by ``R rho``; ``R exp(phi) = exp(R phi) R`` is
    exact. The world has the axes of the grid, so its origin does not enter.

    Parameters
    ----------
    T_world_body : (..., 4, 4) array
        Only its rotation is used.
    cov_xi : (..., 6, 6) array
        Covariance of ``xi = [rho, phi]``, on the right of ``T_world_body``, in m and rad.

    Returns
    -------
    (..., 6, 6) array
        Order ``e n h re rn rh``: easting, northing, elevation (m), rotation vector about these axes (rad).
    """
    J_grid_xi = _blocks_from_rotation(T_world_body)
    return J_grid_xi @ cov_xi @ np.swapaxes(J_grid_xi, -1, -2)


def from_grid_covariance(T_world_body, cov_grid):
    """Covariance of ``xi`` from the published one: the inverse of ``to_grid_covariance``; (..., 6, 6)."""
    J_grid_xi = _blocks_from_rotation(T_world_body)
    return np.swapaxes(J_grid_xi, -1, -2) @ cov_grid @ J_grid_xi


def swap_rotation_first(array, axes=-1):
    """Exchange the first and last three entries: our ``[rho, phi]`` and the others' ``[phi, rho]``.

    The order of SciPy, GTSAM and mrcal is spoken here and nowhere else. Its own inverse.

    Parameters
    ----------
    array : (..., 6, ...) array
        Twists, or matrices over twists.
    axes : int or tuple of int
        The axes of length six: ``-1`` for twists, ``(-2, -1)`` for covariances.
    """
    axes = (axes,) if np.isscalar(axes) else tuple(axes)
    array = np.asarray(array)
    assert all(array.shape[axis] == 6 for axis in axes), array.shape
    return np.roll(array, (3,) * len(axes), axis=axes)


def _split(xi):
    xi = np.asarray(xi, dtype=np.float64)
    assert xi.shape[-1] == 6, xi.shape
    return xi[..., :3], xi[..., 3:]


def _squared_angle(xi):
    phi = _split(xi)[1]
    return np.einsum("...i,...i->...", phi, phi)


def _blocks(diagonal, upper_right):
    """``[[diagonal, upper_right], [0, diagonal]]``, the shape of all matrices on twists here."""
    batch = np.broadcast_shapes(diagonal.shape[:-2], upper_right.shape[:-2])
    M = np.zeros(batch + (6, 6))
    M[..., :3, :3] = diagonal
    M[..., 3:, 3:] = diagonal
    M[..., :3, 3:] = upper_right
    return M


def _blocks_from_rotation(T):
    R = np.asarray(T, dtype=np.float64)[..., :3, :3]
    return _blocks(R, np.zeros((3, 3)))


# An even function f(X²), sum b_k X^2k, becomes b_0 + c2 X² + c4 X⁴ by X (X² + s)² = 0: fit value and slope at
# X² = -s. In powers of -s: c2 = sum_k>=1 b_k (2 - k) (-s)^(k-1), c4 = sum_k>=2 b_k (k - 1) (-s)^(k-2). An odd
# one, X sum o_k X^2k, becomes c1 X + c3 X³: c1 = sum o_k (1 - k) (-s)^k, c3 = sum_k>=1 o_k k (-s)^(k-1).
_C2_SINC, _C4_SINC = (so3.SINC * (2 - _K))[1:], (so3.SINC * (_K - 1))[2:]
_C1_VERSINE, _C3_VERSINE = so3.VERSINE * (1 - _K), (so3.VERSINE * _K)[1:]
C2_COT, C4_COT = (so3.COT * (2 - _K))[1:], (so3.COT * (_K - 1))[2:]
# d/ds of sum a_k (-s)^k is sum -(k + 1) a_(k+1) (-s)^k.
DC2_COT, DC4_COT = (-_K[: len(c)] * c for c in (C2_COT, C4_COT))
DC2_COT, DC4_COT = DC2_COT[1:], DC4_COT[1:]


def _even_coefficients(s):
    """``c2, c4`` of ``Jl``."""
    return (
        so3.series_or_closed_form(
            s, _C2_SINC, lambda s, th: (4 * th - 5 * np.sin(th) + th * np.cos(th)) / (2 * s * th)
        ),
        so3.series_or_closed_form(
            s, _C4_SINC, lambda s, th: (2 * th - 3 * np.sin(th) + th * np.cos(th)) / (2 * s * s * th)
        ),
    )


def _odd_coefficients(s):
    """``c1, c3`` of ``Jl``."""
    return (
        so3.series_or_closed_form(
            s, _C1_VERSINE, lambda s, th: (4 - th * np.sin(th) - 4 * np.cos(th)) / (2 * s)
        ),
        so3.series_or_closed_form(
            s, _C3_VERSINE, lambda s, th: (2 - th * np.sin(th) - 2 * np.cos(th)) / (2 * s * s)
        ),
    )


def _cot_and_slopes(s, theta):
    """``f = theta/2 cot(theta/2)`` and its first two derivatives in ``s``, by ``2 s f' = f - f² - s/4``."""
    f = 0.5 * theta / np.tan(0.5 * theta)
    df = (f - f * f - 0.25 * s) / (2 * s)
    ddf = -(df + 2 * f * df + 0.25) / (2 * s)
    return f, df, ddf


def _inverse_coefficients(s):
    """``c2, c4`` of ``Jr_inv``."""

    def c2(s, theta):
        f, df, _ = _cot_and_slopes(s, theta)
        return 2 * (1 - f) / s + df

    def c4(s, theta):
        f, df, _ = _cot_and_slopes(s, theta)
        return ((1 - f) / s + df) / s

    return so3.series_or_closed_form(s, C2_COT, c2), so3.series_or_closed_form(s, C4_COT, c4)


def _inverse_coefficient_slopes(s):
    """Derivatives of ``c2, c4`` of ``Jr_inv`` in ``s``."""

    def dc2(s, theta):
        f, df, ddf = _cot_and_slopes(s, theta)
        return -2 * (1 - f) / s**2 - 2 * df / s + ddf

    def dc4(s, theta):
        f, df, ddf = _cot_and_slopes(s, theta)
        return -2 * (1 - f) / s**3 - 2 * df / s**2 + ddf / s

    return so3.series_or_closed_form(s, DC2_COT, dc2), so3.series_or_closed_form(s, DC4_COT, dc4)
