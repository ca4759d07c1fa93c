"""Rotations: exponential, logarithm, Jacobians, and the two ways rotations stand in files.

A rotation is a matrix ``R_target_source``, a rotation vector is ``phi`` in radians, an increment is applied
on the right: ``R @ exp(phi)``. Everything is batched over leading axes.

With ``s = |phi|^2`` each function of ``hat(phi)`` is a polynomial in it whose coefficients are smooth
functions of ``s``. Their closed forms cancel at small angles, their power series are slow at large ones; we
change over at ``s = 4`` (2 rad), where both are still good to a few units in the last place. The usual
change-over at 1e-3 rad leaves a belt around it where up to half of the digits are gone.
"""

from fractions import Fraction
from math import factorial

import numpy as np

SERIES_BELOW_RAD2 = 4.0
_TERMS = 24  # (4 / 4 pi^2)^24 = 1e-24, for the slowest series, that of cot


def _cot_series():
    """Taylor coefficients of ``sqrt(u)/2 * coth(sqrt(u)/2)`` in ``u``: Bernoulli numbers ``B_2k / (2k)!``."""
    cosh = [Fraction(1, 4**k * factorial(2 * k)) for k in range(_TERMS)]
    sinhc = [Fraction(1, 4**k * factorial(2 * k + 1)) for k in range(_TERMS)]
    series: list[Fraction] = []
    for k in range(_TERMS):
        series.append(cosh[k] - sum(series[j] * sinhc[k - j] for j in range(k)))
    return np.array([float(b) for b in series])


COT = _cot_series()
SINC = np.array([1 / factorial(2 * k + 1) for k in range(_TERMS)])
VERSINE = np.array([1 / factorial(2 * k + 2) for k in range(_TERMS)])


def power_series(s, coefficients):
    """``sum_k coefficients[k] * (-s)^k``, by Horner's rule."""
    value = np.full_like(s, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = c - s * value
    return value


def series_or_closed_form(s, coefficients, closed_form):
    """A smooth function of ``s = |phi|^2``: the series below ``SERIES_BELOW_RAD2``, else the closed form.

    Parameters
    ----------
    s : (...,) array
        rad².
    coefficients : (n,) array
        Of the powers of ``-s``.
    closed_form : callable
        Of ``(s, theta)``; never called with ``s`` below the change-over.

    Returns
    -------
    (...,) array
    """
    small = s < SERIES_BELOW_RAD2
    if np.all(small):
        return power_series(s, coefficients)
    s_large = np.where(small, SERIES_BELOW_RAD2, s)
    series = power_series(np.where(small, s, 0.0), coefficients)
    return np.where(small, series, closed_form(s_large, np.sqrt(s_large)))


def hat(phi):
    """Skew matrix of a vector: ``hat(a) @ b = a x b``.

    Parameters
    ----------
    phi : (..., 3) array
        In any unit.

    Returns
    -------
    (..., 3, 3) array
    """
    phi = np.asarray(phi, dtype=np.float64)
    assert phi.shape[-1] == 3, phi.shape
    W = np.zeros(phi.shape[:-1] + (3, 3))
    W[..., 2, 1] = phi[..., 0]
    W[..., 0, 2] = phi[..., 1]
    W[..., 1, 0] = phi[..., 2]
    W[..., 1, 2] = -phi[..., 0]
    W[..., 2, 0] = -phi[..., 1]
    W[..., 0, 1] = -phi[..., 2]
    return W


def vee(W):
    """Vector of a skew matrix, the inverse of ``hat``; of any other matrix, that of its skew part."""
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], axis=-1
    )


def _squared_norm(phi):
    return np.einsum("...i,...i->...", phi, phi)


def _polynomial(phi, linear, quadratic):
    """``I + linear * hat(phi) + quadratic * hat(phi)^2``."""
    W = hat(phi)
    linear, quadratic = np.asarray(linear), np.asarray(quadratic)
    return np.eye(3) + linear[..., None, None] * W + quadratic[..., None, None] * (W @ W)


def exp(phi):
    """Rotation matrix of a rotation vector (Rodrigues).

    Parameters
    ----------
    phi : (..., 3) array
        Radians, of any length.

    Returns
    -------
    (..., 3, 3) array
    """
    phi = np.asarray(phi, dtype=np.float64)
    theta = np.sqrt(_squared_norm(phi))
    # np.sinc is exact at 0 and (1 - cos) / s = sinc(theta/2)^2 / 2 has no cancellation: no series needed.
    return _polynomial(phi, np.sinc(theta / np.pi), 0.5 * np.sinc(theta / (2 * np.pi)) ** 2)


def log(R):
    """Rotation vector of a rotation matrix, of length at most pi.

    Goes through the quaternion: the trace formula loses half of the digits at 0 and at pi, the quaternion
    none. At exactly pi both signs of the axis are right; which one comes back is not defined.

    Parameters
    ----------
    R : (..., 3, 3) array
        A rotation, to rounding.

    Returns
    -------
    (..., 3) array
        Radians.
    """
    q = to_quaternion(R)
    v, w = q[..., :3], q[..., 3]
    n = np.sqrt(_squared_norm(v))
    tiny = n < 1e-150
    factor = np.where(tiny, 2.0, 2.0 * np.arctan2(n, w) / np.where(tiny, 1.0, n))
    return factor[..., None] * v


def Jl(phi):
    """Left Jacobian: ``exp(phi + d) = exp(Jl(phi) d) @ exp(phi)`` to first order in ``d``.

    Parameters
    ----------
    phi : (..., 3) array
        Radians.

    Returns
    -------
    (..., 3, 3) array
    """
    phi = np.asarray(phi, dtype=np.float64)
    s = _squared_norm(phi)
    quadratic = series_or_closed_form(s, SINC[1:], lambda s, theta: (theta - np.sin(theta)) / (s * theta))
    return _polynomial(phi, 0.5 * np.sinc(np.sqrt(s) / (2 * np.pi)) ** 2, quadratic)


def Jl_inv(phi):
    """Inverse of ``Jl``; singular at 2 pi, and of no use beyond."""
    phi = np.asarray(phi, dtype=np.float64)
    s = _squared_norm(phi)
    quadratic = series_or_closed_form(s, COT[1:], lambda s, th: (1 - 0.5 * th / np.tan(0.5 * th)) / s)
    return _polynomial(phi, np.full_like(s, -0.5), quadratic)


def Jr(phi):
    """Right Jacobian: ``exp(phi + d) = exp(phi) @ exp(Jr(phi) d)`` to first order in ``d``; (..., 3, 3)."""
    return Jl(-np.asarray(phi, dtype=np.float64))


def Jr_inv(phi):
    """Inverse of ``Jr``: how ``log(exp(phi) @ exp(d))`` moves with ``d``; singular at 2 pi; (..., 3, 3)."""
    return Jl_inv(-np.asarray(phi, dtype=np.float64))


def from_rpy_deg(rpy_deg):
    """Rotation matrix ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``.

    Parameters
    ----------
    rpy_deg : (..., 3) array
        Roll, pitch, yaw in degrees, in this order: the order in the files.

    Returns
    -------
    (..., 3, 3) array
    """
    rpy = np.deg2rad(np.asarray(rpy_deg, dtype=np.float64))
    Rx, Ry, Rz = (exp(rpy[..., i : i + 1] * np.eye(3)[i]) for i in range(3))
    return Rz @ Ry @ Rx


def to_rpy_deg(R):
    """Roll, pitch, yaw in degrees, with ``from_rpy_deg(to_rpy_deg(R)) = R`` everywhere.

    Roll comes from ``Rz(yaw)^T R`` and not from the last row of ``R``: at a pitch of ±90 degrees, where
    only one combination of roll and yaw is defined, the pair is then still one that gives ``R`` back.

    Parameters
    ----------
    R : (..., 3, 3) array
        A rotation, to rounding.

    Returns
    -------
    (..., 3) array
        Roll and yaw in (-180, 180], pitch in [-90, 90].
    """
    R = np.asarray(R, dtype=np.float64)
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * R[..., 0, 2] - c * R[..., 1, 2], c * R[..., 1, 1] - s * R[..., 0, 1])
    return np.rad2deg(np.stack([roll, pitch, yaw], axis=-1))


def from_quaternion(q_xyzw):
    """Rotation matrix of a quaternion ``x y z w``.

    Parameters
    ----------
    q_xyzw : (..., 4) array
        Of any length but zero; ``q`` and ``-q`` are the same rotation.

    Returns
    -------
    (..., 3, 3) array
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3]
    W = hat(v)
    return np.eye(3) + 2 * w[..., None, None] * W + 2 * (W @ W)


def to_quaternion(R):
    """Unit quaternion ``x y z w`` with ``w >= 0`` of a rotation matrix.

    Of the four ways to divide, the one with the largest divisor is taken (Shepperd), so no digit is lost at
    any angle.

    Parameters
    ----------
    R : (..., 3, 3) array
        A rotation, to rounding.

    Returns
    -------
    (..., 4) array
    """
    R = np.asarray(R, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # 4 q q^T: every row is the quaternion, times four of its elements in turn.
    rows = [
        [1 + xx - yy - zz, xy, xz, xw],
        [xy, 1 - xx + yy - zz, yz, yw],
        [xz, yz, 1 - xx - yy + zz, zw],
        [xw, yw, zw, 1 + xx + yy + zz],
    ]
    four_qq = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.diagonal(four_qq, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(four_qq, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)
