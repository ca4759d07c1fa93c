"""Compiled kernels of the motion of bodies: its cost, and its normal equations added up pair by pair.

They compute what ``motion.pose_residual`` computes, which is their oracle in the tests, and square it at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.geometry import se3, so3

_JL_INV = so3.COT[1:]
_C2, _C4 = se3.C2_COT, se3.C4_COT
_DC2, _DC4 = se3.DC2_COT, se3.DC4_COT
_CLOSED_ABOVE = so3.SERIES_BELOW_RAD2
_FEW_TERMS_BELOW, _FEW_TERMS = 0.25, 10  # (0.25 / 4 pi²)^10 = 1e-22


@njit(cache=True, error_model="numpy", inline="always")
def _power_series(s, coefficients):
    n = _FEW_TERMS if s < _FEW_TERMS_BELOW else len(coefficients)
    value = coefficients[n - 1]
    for j in range(n - 2, -1, -1):
        value = coefficients[j] - s * value
    return value


@njit(cache=True, error_model="numpy")
def _local(T_1, T_2, xi):
    """``log(inverse(T_1) @ T_2)``."""
    R = np.empty((3, 3))
    d0, d1, d2 = T_2[0, 3] - T_1[0, 3], T_2[1, 3] - T_1[1, 3], T_2[2, 3] - T_1[2, 3]
    for a in range(3):
        xi[a] = T_1[0, a] * d0 + T_1[1, a] * d1 + T_1[2, a] * d2
        for b in range(3):
            R[a, b] = T_1[0, a] * T_2[0, b] + T_1[1, a] * T_2[1, b] + T_1[2, a] * T_2[2, b]
    # The quaternion by the largest divisor, as so3.to_quaternion.
    w4 = 1 + R[0, 0] + R[1, 1] + R[2, 2]
    x4 = 1 + R[0, 0] - R[1, 1] - R[2, 2]
    y4 = 1 - R[0, 0] + R[1, 1] - R[2, 2]
    z4 = 1 - R[0, 0] - R[1, 1] + R[2, 2]
    xw, yw, zw = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    if w4 >= x4 and w4 >= y4 and w4 >= z4:
        x, y, z, w = xw, yw, zw, w4
    elif x4 >= y4 and x4 >= z4:
        x, y, z, w = x4, xy, xz, xw
    elif y4 >= z4:
        x, y, z, w = xy, y4, yz, yw
    else:
        x, y, z, w = xz, yz, z4, zw
    if w < 0:
        x, y, z, w = -x, -y, -z, -w
    n = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 * np.arctan2(n, w) / n if n > 1e-150 else 0.0
    px, py, pz = scale * x, scale * y, scale * z
    xi[3], xi[4], xi[5] = px, py, pz
    s = px * px + py * py + pz * pz
    if s < _CLOSED_ABOVE:
        c = _power_series(s, _JL_INV)
    else:
        theta = np.sqrt(s)
        c = (1 - 0.5 * theta / np.tan(0.5 * theta)) / s
    # rho = t - phi x t / 2 + c phi x (phi x t)
    t0, t1, t2 = xi[0], xi[1], xi[2]
    a0, a1, a2 = py * t2 - pz * t1, pz * t0 - px * t2, px * t1 - py * t0
    xi[0] = t0 - 0.5 * a0 + c * (py * a2 - pz * a1)
    xi[1] = t1 - 0.5 * a1 + c * (pz * a0 - px * a2)
    xi[2] = t2 - 0.5 * a2 + c * (px * a1 - py * a0)


@njit(cache=True, error_model="numpy")
def _coefficients(s, out):
    """``c2, c4`` of ``se3.Jr_inv`` and their slopes in s."""
    if s < _CLOSED_ABOVE:
        out[0], out[1] = _power_series(s, _C2), _power_series(s, _C4)
        out[2], out[3] = _power_series(s, _DC2), _power_series(s, _DC4)
        return
    theta = np.sqrt(s)
    f = 0.5 * theta / np.tan(0.5 * theta)
    df = (f - f * f - 0.25 * s) / (2 * s)
    ddf = -(df + 2 * f * df + 0.25) / (2 * s)
    out[0], out[1] = 2 * (1 - f) / s + df, ((1 - f) / s + df) / s
    out[2] = -2 * (1 - f) / s**2 - 2 * df / s + ddf
    out[3] = -2 * (1 - f) / s**3 - 2 * df / s**2 + ddf / s


@njit(cache=True, error_model="numpy", inline="always")
def _ad_times(xi, v, out):
    """``ad(xi) v``."""
    a0, a1, a2, b0, b1, b2 = xi[0], xi[1], xi[2], xi[3], xi[4], xi[5]
    out[0] = b1 * v[2] - b2 * v[1] + a1 * v[5] - a2 * v[4]
    out[1] = b2 * v[0] - b0 * v[2] + a2 * v[3] - a0 * v[5]
    out[2] = b0 * v[1] - b1 * v[0] + a0 * v[4] - a1 * v[3]
    out[3] = b1 * v[5] - b2 * v[4]
    out[4] = b2 * v[3] - b0 * v[5]
    out[5] = b0 * v[4] - b1 * v[3]


@njit(cache=True, error_model="numpy", inline="always")
def _ad(xi, out):
    a0, a1, a2, b0, b1, b2 = xi[0], xi[1], xi[2], xi[3], xi[4], xi[5]
    out[:] = 0.0
    for o in (0, 3):
        out[o, o + 1], out[o, o + 2], out[o + 1, o + 2] = -b2, b1, -b0
        out[o + 1, o], out[o + 2, o], out[o + 2, o + 1] = b2, -b1, b0
    out[0, 4], out[0, 5], out[1, 5] = -a2, a1, -a0
    out[1, 3], out[2, 3], out[2, 4] = a2, -a1, a0


@njit(cache=True, error_model="numpy", inline="always")
def _product(A, B, out):
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
        for n in range(6):
            f = A[i, n]
            for j in range(6):
                out[i, j] += f * B[n, j]


@njit(cache=True, error_model="numpy")
def _velocity(xi, w, c, powers):
    """``ad(xi)^n w`` for n = 0 to 4 into ``powers``; ``Jr_inv(xi) w`` follows."""
    powers[0] = w
    for n in range(4):
        _ad_times(xi, powers[n], powers[n + 1])


@njit(cache=True, error_model="numpy", nogil=True)
def motion_costs(T, w, dt_s, W, local):
    """Half the squared motion residual of a moving body, added to the first epoch of each pair in ``local``."""
    xi, c, powers = np.empty(6), np.empty(4), np.empty((5, 6))
    for i in range(len(dt_s)):
        _local(T[i], T[i + 1], xi)
        _coefficients(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2, c)
        _velocity(xi, w[i + 1], c, powers)
        total = 0.0
        for j in range(6):
            e_1 = xi[j] - dt_s[i] * w[i, j]
            e_2 = powers[0, j] + 0.5 * powers[1, j] + c[0] * powers[2, j] + c[1] * powers[4, j] - w[i, j]
            total += (W[i, j, 0] * e_1) ** 2 + (W[i, j, 1] * e_1 + W[i, j, 2] * e_2) ** 2
        local[i] += 0.5 * total


@njit(cache=True, error_model="numpy", nogil=True)
def add_motion(T, w, dt_s, W, at, D, A, g):
    """Add the motion residuals of a moving body to the blocks of its chain.

    Parameters
    ----------
    T, w : (E, 4, 4), (E, 6) arrays
        Pose in the anchor and velocity in the body.
    dt_s : (E - 1,) array
        Between two epochs.
    W : (E - 1, 6, 3) array
        Of ``motion.whitening``.
    at : int
        Where the body's twelve stand in the chain's block.
    D, A, g : (E, b, b), (E - 1, b, b), (E, b) arrays
        Added to.
    """
    xi, c, powers = np.empty(6), np.empty(4), np.empty((5, 6))
    X, X2, X4, G = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    Q, Q1, aw = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    Jr, Jl, GJr, GJl = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    J_1, J_2, e = np.zeros((12, 12)), np.zeros((12, 12)), np.empty(12)
    for i in range(len(dt_s)):
        dt = dt_s[i]
        _local(T[i], T[i + 1], xi)
        _coefficients(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2, c)
        _velocity(xi, w[i + 1], c, powers)
        _ad(xi, X)
        _product(X, X, X2)
        _product(X2, X2, X4)
        # se3.jr_inv_times_derivative: dQ_n+1 = X dQ_n - ad(X^n w)
        G[:] = 0.0
        Q[:] = 0.0
        for n in range(4):
            _ad(powers[n], aw)
            _product(X, Q, Q1)
            f = 0.5 if n == 0 else (c[0] if n == 1 else (c[1] if n == 3 else 0.0))
            for u in range(6):
                for j in range(6):
                    Q[u, j] = Q1[u, j] - aw[u, j]
                    G[u, j] += f * Q[u, j]
        for u in range(6):
            slope = 2 * (c[2] * powers[2, u] + c[3] * powers[4, u])
            for j in range(3):
                G[u, 3 + j] += slope * xi[3 + j]
            for j in range(6):
                even = c[0] * X2[u, j] + c[1] * X4[u, j] + (1.0 if u == j else 0.0)
                Jr[u, j] = even + 0.5 * X[u, j]
                Jl[u, j] = even - 0.5 * X[u, j]
        _product(G, Jr, GJr)
        _product(G, Jl, GJl)
        for u in range(6):
            w00, w10, w11 = W[i, u, 0], W[i, u, 1], W[i, u, 2]
            e_1 = xi[u] - dt * w[i, u]
            e_2 = powers[0, u] + 0.5 * powers[1, u] + c[0] * powers[2, u] + c[1] * powers[4, u] - w[i, u]
            e[u] = w00 * e_1
            e[6 + u] = w10 * e_1 + w11 * e_2
            for j in range(6):
                J_1[u, j] = -w00 * Jl[u, j]
                J_1[6 + u, j] = -w10 * Jl[u, j] - w11 * GJl[u, j]
                J_2[u, j] = w00 * Jr[u, j]
                J_2[6 + u, j] = w10 * Jr[u, j] + w11 * GJr[u, j]
                J_2[6 + u, 6 + j] = w11 * Jr[u, j]
            J_1[u, 6 + u] = -w00 * dt
            J_1[6 + u, 6 + u] = -w10 * dt - w11
        D_1, D_2, A_12 = D[i], D[i + 1], A[i]
        for n in range(12):
            en = e[n]
            last = 12 if n >= 6 else 6  # the first six rows of J_2 know no velocity
            for u in range(12):
                f = J_1[n, u]
                g[i, at + u] += f * en
                if f != 0.0:
                    for j in range(12):
                        D_1[at + u, at + j] += f * J_1[n, j]
                    for j in range(last):
                        A_12[at + u, at + j] += f * J_2[n, j]
            for u in range(last):
                f = J_2[n, u]
                g[i + 1, at + u] += f * en
                for j in range(last):
                    D_2[at + u, at + j] += f * J_2[n, j]
