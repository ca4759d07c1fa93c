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
_SMALL = 1e-3  # rad²; the first term that is left out is 1e-17 of the whole
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


@njit(cache=True, error_model="numpy", nogil=True)
def retract(T, d, out):
    """``T exp(d)`` of poses (n, 4, 4) and steps (n, 6 or more), translation first, into ``out``: ``se3.retract``.

    With ``a = sin(t) / t``, ``b = (1 - cos t) / t²`` and ``c = (1 - a) / t²``: ``R = 1 + a hat(phi) + b hat(phi)²`` and
    ``V rho = rho + b phi x rho + c phi x (phi x rho)``.
    """
    for i in range(len(T)):
        r0, r1, r2, x, y, z = d[i, 0], d[i, 1], d[i, 2], d[i, 3], d[i, 4], d[i, 5]
        s = x * x + y * y + z * z
        if s < _SMALL:
            a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42))
            b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56))
            c = 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72))
        else:
            t = np.sqrt(s)
            half = np.sin(0.5 * t)
            a = np.sin(t) / t
            b = 2 * half * half / s
            c = (1 - a) / s
        k0, k1, k2 = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
        v0 = r0 + b * k0 + c * (y * k2 - z * k1)
        v1 = r1 + b * k1 + c * (z * k0 - x * k2)
        v2 = r2 + b * k2 + c * (x * k1 - y * k0)
        e00, e11, e22 = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
        e01, e10 = b * x * y - a * z, b * x * y + a * z
        e02, e20 = b * x * z + a * y, b * x * z - a * y
        e12, e21 = b * y * z - a * x, b * y * z + a * x
        for u in range(3):
            p0, p1, p2 = T[i, u, 0], T[i, u, 1], T[i, u, 2]
            out[i, u, 0] = p0 * e00 + p1 * e10 + p2 * e20
            out[i, u, 1] = p0 * e01 + p1 * e11 + p2 * e21
            out[i, u, 2] = p0 * e02 + p1 * e12 + p2 * e22
            out[i, u, 3] = p0 * v0 + p1 * v1 + p2 * v2 + T[i, u, 3]
            out[i, 3, u] = 0.0
        out[i, 3, 3] = 1.0


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
def _add_cross(v0, v1, v2, M, out):
    """``out += hat(v) M``, 3 by 3."""
    for j in range(3):
        out[0, j] += v1 * M[2, j] - v2 * M[1, j]
        out[1, j] += v2 * M[0, j] - v0 * M[2, j]
        out[2, j] += v0 * M[1, j] - v1 * M[0, j]


@njit(cache=True, error_model="numpy", inline="always")
def _add_hat(v0, v1, v2, out):
    out[0, 1] -= v2
    out[0, 2] += v1
    out[1, 0] += v2
    out[1, 2] -= v0
    out[2, 0] -= v1
    out[2, 1] += v0


@njit(cache=True, error_model="numpy", inline="always")
def _inverse_jacobian(xi, c, half, J_a, J_b):
    """Blocks of ``1 + half X + c0 X² + c1 X⁴`` with ``X = ad(xi)``: J_a on the diagonal, J_b right of it.

    With ``M = hat(phi) hat(rho) + hat(rho) hat(phi) = rho phi' + phi rho' - 2 d``, ``d = phi' rho``, ``s = phi' phi``:
    X² has the blocks ``phi phi' - s`` and M, and X⁴ ``-s (phi phi' - s)`` and ``-s M - 2 d (phi phi' - s)``.
    """
    s = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5]
    d = xi[0] * xi[3] + xi[1] * xi[4] + xi[2] * xi[5]
    both, turned = c[0] - s * c[1], -2.0 * d * c[1]
    for a in range(3):
        for b in range(3):
            J_a[a, b] = both * xi[3 + a] * xi[3 + b]
            J_b[a, b] = both * (xi[a] * xi[3 + b] + xi[3 + a] * xi[b]) + turned * xi[3 + a] * xi[3 + b]
        J_a[a, a] += 1.0 - both * s
        J_b[a, a] -= 2.0 * d * both + turned * s
    _add_hat(half * xi[3], half * xi[4], half * xi[5], J_a)
    _add_hat(half * xi[0], half * xi[1], half * xi[2], J_b)


@njit(cache=True, error_model="numpy", inline="always")
def _add_rows(G_a, G_b, G_d, J_a, J_b, W, K):
    """Rows of ``[w00 J; w10 J + w11 G J]``, (12, 6) of K, of a Jacobian J and ``G = [G_a, G_b; 0, G_d]`` times it."""
    for a in range(3):
        for b in range(3):
            ga = G_a[a, 0] * J_a[0, b] + G_a[a, 1] * J_a[1, b] + G_a[a, 2] * J_a[2, b]
            gd = G_d[a, 0] * J_a[0, b] + G_d[a, 1] * J_a[1, b] + G_d[a, 2] * J_a[2, b]
            gb = G_a[a, 0] * J_b[0, b] + G_a[a, 1] * J_b[1, b] + G_a[a, 2] * J_b[2, b]
            gb += G_b[a, 0] * J_a[0, b] + G_b[a, 1] * J_a[1, b] + G_b[a, 2] * J_a[2, b]
            K[a, b] = W[a, 0] * J_a[a, b]
            K[a, 3 + b] = W[a, 0] * J_b[a, b]
            K[3 + a, 3 + b] = W[3 + a, 0] * J_a[a, b]
            K[6 + a, b] = W[a, 1] * J_a[a, b] + W[a, 2] * ga
            K[6 + a, 3 + b] = W[a, 1] * J_b[a, b] + W[a, 2] * gb
            K[9 + a, 3 + b] = W[3 + a, 1] * J_a[a, b] + W[3 + a, 2] * gd


@njit(cache=True, error_model="numpy", inline="always")
def _square(K, L, width, out):
    """``K' L``, (6, width), of rows that know no translation where they are 3 to 5 or 9 to 11."""
    for u in range(6):
        k0, k1, k2, k6, k7, k8 = K[0, u], K[1, u], K[2, u], K[6, u], K[7, u], K[8, u]
        for j in range(0, width, 2):
            s0 = k0 * L[0, j] + k1 * L[1, j] + k2 * L[2, j] + k6 * L[6, j] + k7 * L[7, j] + k8 * L[8, j]
            s1 = (
                k0 * L[0, j + 1]
                + k1 * L[1, j + 1]
                + k2 * L[2, j + 1]
                + k6 * L[6, j + 1]
                + k7 * L[7, j + 1]
                + k8 * L[8, j + 1]
            )
            out[u, j] = s0
            out[u, j + 1] = s1
    for u in range(3, 6):
        k0, k1, k2, k6, k7, k8 = K[3, u], K[4, u], K[5, u], K[9, u], K[10, u], K[11, u]
        for j in range(2, width, 2):
            s0 = k0 * L[3, j] + k1 * L[4, j] + k2 * L[5, j] + k6 * L[9, j] + k7 * L[10, j] + k8 * L[11, j]
            s1 = (
                k0 * L[3, j + 1]
                + k1 * L[4, j + 1]
                + k2 * L[5, j + 1]
                + k6 * L[9, j + 1]
                + k7 * L[10, j + 1]
                + k8 * L[11, j + 1]
            )
            out[u, j] += s0
            out[u, j + 1] += s1


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
    Q_a, Q_b, R_a, R_b = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    G_a, G_b, G_d = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    J_a, J_b = np.empty((3, 3)), np.empty((3, 3))
    # Rows of -J_1 by the pose, and of J_2: residuals of the pose above, of the velocity below.
    K_1, K_2, e = np.zeros((12, 6)), np.zeros((12, 12)), np.empty(12)
    H_1, H_12, H_2 = np.empty((6, 6)), np.empty((6, 12)), np.empty((6, 12))
    for i in range(len(dt_s)):
        dt = dt_s[i]
        _local(T[i], T[i + 1], xi)
        _coefficients(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2, c)
        _velocity(xi, w[i + 1], c, powers)
        # se3.jr_inv_times_derivative: dQ_n+1 = X dQ_n - ad(X^n w)
        for a in range(3):
            for b in range(3):
                Q_a[a, b] = Q_b[a, b] = G_a[a, b] = G_b[a, b] = 0.0
        for n in range(4):
            p = powers[n]
            for a in range(3):
                for b in range(3):
                    R_a[a, b] = R_b[a, b] = 0.0
            _add_cross(xi[3], xi[4], xi[5], Q_a, R_a)
            _add_cross(xi[3], xi[4], xi[5], Q_b, R_b)
            _add_cross(xi[0], xi[1], xi[2], Q_a, R_b)
            _add_hat(-p[3], -p[4], -p[5], R_a)
            _add_hat(-p[0], -p[1], -p[2], R_b)
            f = 0.5 if n == 0 else (c[0] if n == 1 else (c[1] if n == 3 else 0.0))
            for a in range(3):
                for b in range(3):
                    Q_a[a, b], Q_b[a, b] = R_a[a, b], R_b[a, b]
                    G_a[a, b] += f * R_a[a, b]
                    G_b[a, b] += f * R_b[a, b]
        for a in range(3):
            slope_b = 2 * (c[2] * powers[2, a] + c[3] * powers[4, a])
            slope_d = 2 * (c[2] * powers[2, 3 + a] + c[3] * powers[4, 3 + a])
            for b in range(3):
                G_b[a, b] += slope_b * xi[3 + b]
                G_d[a, b] = G_a[a, b] + slope_d * xi[3 + b]
        _inverse_jacobian(xi, c, -0.5, J_a, J_b)
        _add_rows(G_a, G_b, G_d, J_a, J_b, W[i], K_1)
        _inverse_jacobian(xi, c, 0.5, J_a, J_b)
        _add_rows(G_a, G_b, G_d, J_a, J_b, W[i], K_2)
        for a in range(3):
            for b in range(3):
                K_2[6 + a, 6 + b] = W[i, a, 2] * J_a[a, b]
                K_2[6 + a, 9 + b] = W[i, a, 2] * J_b[a, b]
                K_2[9 + a, 9 + b] = W[i, 3 + a, 2] * J_a[a, b]
        for u in range(6):
            e_1 = xi[u] - dt * w[i, u]
            e_2 = powers[0, u] + 0.5 * powers[1, u] + c[0] * powers[2, u] + c[1] * powers[4, u] - w[i, u]
            e[u] = W[i, u, 0] * e_1
            e[6 + u] = W[i, u, 1] * e_1 + W[i, u, 2] * e_2
        _square(K_1, K_1, 6, H_1)
        _square(K_1, K_2, 12, H_12)
        _square(K_2, K_2, 12, H_2)
        D_1, D_2, A_12, g_1, g_2 = D[i], D[i + 1], A[i], g[i], g[i + 1]
        for u in range(6):
            # By the first velocity a residual is -f_1 or -f_2, alone in its row.
            f_1, f_2 = dt * W[i, u, 0], dt * W[i, u, 1] + W[i, u, 2]
            for j in range(6):
                D_1[at + u, at + j] += H_1[u, j]
                A_12[at + u, at + j] -= H_12[u, j]
                A_12[at + u, at + 6 + j] -= H_12[u, 6 + j]
                D_2[at + u, at + j] += H_2[u, j]
                D_2[at + u, at + 6 + j] += H_2[u, 6 + j]
                D_2[at + 6 + j, at + u] += H_2[u, 6 + j]
                f = f_1 * K_1[u, j] + f_2 * K_1[6 + u, j]
                D_1[at + 6 + u, at + j] += f
                D_1[at + j, at + 6 + u] += f
                A_12[at + 6 + u, at + j] -= f_1 * K_2[u, j] + f_2 * K_2[6 + u, j]
                A_12[at + 6 + u, at + 6 + j] -= f_2 * K_2[6 + u, 6 + j]
                s = (
                    K_2[6, 6 + u] * K_2[6, 6 + j]
                    + K_2[7, 6 + u] * K_2[7, 6 + j]
                    + K_2[8, 6 + u] * K_2[8, 6 + j]
                )
                if u >= 3:
                    s += K_2[9, 6 + u] * K_2[9, 6 + j] + K_2[10, 6 + u] * K_2[10, 6 + j]
                    s += K_2[11, 6 + u] * K_2[11, 6 + j]
                D_2[at + 6 + u, at + 6 + j] += s
            D_1[at + 6 + u, at + 6 + u] += f_1 * f_1 + f_2 * f_2
            g_1[at + 6 + u] -= f_1 * e[u] + f_2 * e[6 + u]
            s_1 = s_2 = s_3 = 0.0
            for n in range(6):
                s_1 += K_1[n, u] * e[n] + K_1[6 + n, u] * e[6 + n]
                s_2 += K_2[n, u] * e[n] + K_2[6 + n, u] * e[6 + n]
                s_3 += K_2[6 + n, 6 + u] * e[6 + n]
            g_1[at + u] -= s_1
            g_2[at + u] += s_2
            g_2[at + 6 + u] += s_3
