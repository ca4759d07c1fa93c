"""Compiled kernels of corners: their cost, and their normal equations added up row by row.

They compute what ``residuals.corner_residuals`` computes, which is their oracle in the tests, and square it at once:
only the blocks themselves are ever in memory. In array operations nearly all of the time went into temporaries.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.geometry.camera import NEAREST_M


@njit(cache=True, error_model="numpy", inline="always")
def _walk(i, T, sign, R, t):
    """Rotation and origin of every child frame along the path at row i, and of its end at index m."""
    m = len(sign)
    R_now, t_now = R[m], t[m]
    for a in range(3):
        t_now[a] = 0.0
        for b in range(3):
            R_now[a, b] = 1.0 if a == b else 0.0
    for s in range(m):
        E = T[s, i if T.shape[1] > 1 else 0]
        if sign[s] < 0:
            for a in range(3):
                t[s, a] = t_now[a]
                for b in range(3):
                    R[s, a, b] = R_now[a, b]
            # T @ inverse(E): R E_R', t - R E_R' E_t
            for a in range(3):
                r0, r1, r2 = R[s, a, 0], R[s, a, 1], R[s, a, 2]
                for b in range(3):
                    R_now[a, b] = r0 * E[b, 0] + r1 * E[b, 1] + r2 * E[b, 2]
            for a in range(3):
                t_now[a] -= R_now[a, 0] * E[0, 3] + R_now[a, 1] * E[1, 3] + R_now[a, 2] * E[2, 3]
        else:
            for a in range(3):
                r0, r1, r2 = R_now[a, 0], R_now[a, 1], R_now[a, 2]
                t_now[a] += r0 * E[0, 3] + r1 * E[1, 3] + r2 * E[2, 3]
                for b in range(3):
                    R_now[a, b] = r0 * E[0, b] + r1 * E[1, b] + r2 * E[2, b]
            for a in range(3):
                t[s, a] = t_now[a]
                for b in range(3):
                    R[s, a, b] = R_now[a, b]


@njit(cache=True, error_model="numpy", inline="always")
def _point(R, t, p, out):
    for a in range(3):
        out[a] = R[a, 0] * p[0] + R[a, 1] * p[1] + R[a, 2] * p[2] + t[a]


@njit(cache=True, error_model="numpy", inline="always")
def _residual(p, c, uv, constant, L, r):
    """Whitened residual of one corner into r; False where it lies behind the camera."""
    if not p[2] > NEAREST_M:
        return False
    x, y = p[0] / p[2], p[1] / p[2]
    r2 = x * x + y * y
    radial = 1 + r2 * (c[4] + r2 * (c[5] + r2 * c[8]))
    du = uv[0] - constant[0] - (c[0] * (x * radial + 2 * c[6] * x * y + c[7] * (r2 + 2 * x * x)) + c[2])
    dv = uv[1] - constant[1] - (c[1] * (y * radial + c[6] * (r2 + 2 * y * y) + 2 * c[7] * x * y) + c[3])
    r[0] = L[0, 0] * du + L[0, 1] * dv
    r[1] = L[1, 0] * du + L[1, 1] * dv
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def corner_costs(epoch, p_marker, uv, whitener, share, alive, T, sign, intrinsics, constant, k, lost, local):
    """Huber's cost of every corner, added to its epoch in ``local`` (E,)."""
    m = len(sign)
    R, t, p, r = np.empty((m + 1, 3, 3)), np.empty((m + 1, 3)), np.empty(3), np.empty(2)
    for i in range(len(epoch)):
        _walk(i, T, sign, R, t)
        for corner in range(4):
            if not alive[i, corner]:
                continue
            _point(R[m], t[m], p_marker[i, corner], p)
            length = lost
            if _residual(p, intrinsics, uv[i, corner], constant[corner], whitener[i, corner], r):
                length = np.sqrt(r[0] * r[0] + r[1] * r[1])
            cost = 0.5 * length * length if length <= k else k * (length - 0.5 * k)
            local[epoch[i]] += share[i] * cost


@njit(cache=True, error_model="numpy", nogil=True)
def corner_lengths(p_marker, uv, whitener, T, sign, intrinsics, constant, lengths):
    """Length of every corner's whitened residual into ``lengths`` (n, 4); nan where it lies behind the camera."""
    m = len(sign)
    R, t, p, r = np.empty((m + 1, 3, 3)), np.empty((m + 1, 3)), np.empty(3), np.empty(2)
    for i in range(len(p_marker)):
        _walk(i, T, sign, R, t)
        for corner in range(4):
            _point(R[m], t[m], p_marker[i, corner], p)
            lengths[i, corner] = np.nan
            if _residual(p, intrinsics, uv[i, corner], constant[corner], whitener[i, corner], r):
                lengths[i, corner] = np.sqrt(r[0] * r[0] + r[1] * r[1])


@njit(cache=True, error_model="numpy", nogil=True)
def add_corners(
    epoch,
    p_marker,
    uv,
    whitener,
    share,
    alive,
    T,
    sign,
    column,
    width,
    K,
    clock,
    clock_width,
    K_clock,
    intrinsics,
    intrinsics_column,
    K_intrinsics,
    constant,
    constant_column,
    K_constant,
    k,
    newton,
    x_at,
    border_at,
    D,
    g,
    B,
    C,
    g_z,
):
    """Add the corners of one group to the blocks of their chain.

    The group's own columns are first those of the state, then those of the statics.

    Parameters
    ----------
    epoch : (n,) int array
        Of ``Corners``.
    p_marker, uv, whitener : (n, 4, 3), (n, 4, 2), (n, 4, 2, 2) arrays
        Of ``Corners``.
    share : (n,) array
        What a sighting keeps of its information.
    alive : (n, 4) bool array
        Of ``Weights``.
    T : (m, n or 1, 4, 4) array
        ``T_parent_child`` of each edge of the path.
    sign : (m,) int array
        Of each step.
    column, width : (m,) int arrays
        First of the group's columns that the edge's error moves with, and how many.
    K : (m, 6, w) array
        The edge's right perturbation by those columns.
    clock, clock_width : (m,) int arrays
        First of the group's columns of the clock of a joint, or -1 where it is exact, and how many.
    K_clock : (m, n or 1, 1 + w) array
        A joint's turn by its rate, for it is seen late, and by those columns; the former in the column after its own.
    intrinsics : (9,) array
        In the order of ``camera.INTRINSICS``.
    intrinsics_column : int
        First of the group's columns that they move with.
    K_intrinsics : (9, w) array
        The intrinsics by those columns.
    constant : (4, 2) array
        Constant errors of the corners, px.
    constant_column : int
        First of the group's columns that they move with.
    K_constant : (4, 2, w) array
        Constant errors by their columns.
    k : float
        Huber's threshold.
    newton : bool
        See ``linearise``.
    x_at : (cx,) int array
        Places in the state's block of the group's state columns.
    border_at : (cz,) int array
        Places in the chain's border of its other columns.
    D, g, B : (E, b, b), (E, b), (E, b, q) arrays
        Blocks of the chain, added to.
    C, g_z : (cz, cz), (cz,) arrays
        Blocks of the group's statics, added to.
    """
    m, cx, cz = len(sign), len(x_at), len(border_at)
    c = cx + cz
    wi, wc = K_intrinsics.shape[1], K_constant.shape[2]
    fx0, fy0, c4, c5, c6, c7, c8 = (
        intrinsics[0],
        intrinsics[1],
        intrinsics[4],
        intrinsics[5],
        intrinsics[6],
        intrinsics[7],
        intrinsics[8],
    )
    R, t, p, q, r = np.empty((m + 1, 3, 3)), np.empty((m + 1, 3)), np.empty(3), np.empty(3), np.empty(2)
    J_p, J_i, J = np.empty((2, 3)), np.empty((2, 9)), np.empty((2, 6))
    a = np.empty((2, c))
    rows = np.empty((8, c))
    H = np.empty((c, c))
    grad = np.empty(c)
    plain = np.zeros(m, dtype=np.bool_)  # a body's own error, component by component
    for s in range(m):
        plain[s] = width[s] == 6 and np.all(K[s, :, :6] == np.eye(6))
    for i in range(len(epoch)):
        _walk(i, T, sign, R, t)
        used = 0
        grad[:] = 0.0
        for corner in range(4):
            if not alive[i, corner]:
                continue
            _point(R[m], t[m], p_marker[i, corner], p)
            L = whitener[i, corner]
            if not _residual(p, intrinsics, uv[i, corner], constant[corner], L, r):
                continue
            length = np.sqrt(r[0] * r[0] + r[1] * r[1])
            weight = k / length if length > k else 1.0
            x, y, z = p[0] / p[2], p[1] / p[2], p[2]
            r2 = x * x + y * y
            radial = 1 + r2 * (c4 + r2 * (c5 + r2 * c8))
            slope = 2 * (c4 + r2 * (2 * c5 + r2 * 3 * c8))
            mixed = slope * x * y + 2 * c6 * x + 2 * c7 * y
            ux = fx0 * (radial + slope * x * x + 2 * c6 * y + 6 * c7 * x) / z
            uy = fx0 * mixed / z
            vx = fy0 * mixed / z
            vy = fy0 * (radial + slope * y * y + 6 * c6 * y + 2 * c7 * x) / z
            uz = -(ux * x + uy * y)
            vz = -(vx * x + vy * y)
            for e in range(2):  # observed minus predicted
                J_p[e, 0] = -(L[e, 0] * ux + L[e, 1] * vx)
                J_p[e, 1] = -(L[e, 0] * uy + L[e, 1] * vy)
                J_p[e, 2] = -(L[e, 0] * uz + L[e, 1] * vz)
                for j in range(c):
                    a[e, j] = 0.0
            for s in range(m):
                if width[s] == 0 and clock[s] < 0:
                    continue
                R_s, t_s = R[s], t[s]
                for b in range(3):
                    q[b] = (
                        R_s[0, b] * (p[0] - t_s[0])
                        + R_s[1, b] * (p[1] - t_s[1])
                        + R_s[2, b] * (p[2] - t_s[2])
                    )
                for e in range(2):
                    for b in range(3):
                        J[e, b] = sign[s] * (
                            J_p[e, 0] * R_s[0, b] + J_p[e, 1] * R_s[1, b] + J_p[e, 2] * R_s[2, b]
                        )
                    J[e, 3] = J[e, 2] * q[1] - J[e, 1] * q[2]
                    J[e, 4] = J[e, 0] * q[2] - J[e, 2] * q[0]
                    J[e, 5] = J[e, 1] * q[0] - J[e, 0] * q[1]
                    at = column[s]
                    if plain[s]:
                        for b in range(6):
                            a[e, at + b] += J[e, b]
                    else:
                        j0, j1, j2, j3, j4, j5 = J[e, 0], J[e, 1], J[e, 2], J[e, 3], J[e, 4], J[e, 5]
                        for j in range(width[s]):
                            a[e, at + j] += (j0 * K[s, 0, j] + j1 * K[s, 1, j] + j2 * K[s, 2, j]) + (
                                j3 * K[s, 3, j] + j4 * K[s, 4, j] + j5 * K[s, 5, j]
                            )
                    if clock[s] >= 0:
                        by_clock = K_clock[s, i if K_clock.shape[1] > 1 else 0]
                        a[e, at + 1] += J[e, 5] * by_clock[0]
                        for j in range(clock_width[s]):
                            a[e, clock[s] + j] += J[e, 5] * by_clock[1 + j]
            if wi > 0:
                xd = x * radial + 2 * c6 * x * y + c7 * (r2 + 2 * x * x)
                yd = y * radial + c6 * (r2 + 2 * y * y) + 2 * c7 * x * y
                for e in range(2):
                    lu, lv = -L[e, 0], -L[e, 1]
                    J_i[e, 0], J_i[e, 1], J_i[e, 2], J_i[e, 3] = lu * xd, lv * yd, lu, lv
                    fx, fy = lu * fx0 * x + lv * fy0 * y, 2 * x * y
                    J_i[e, 4], J_i[e, 5], J_i[e, 8] = fx * r2, fx * r2 * r2, fx * r2 * r2 * r2
                    J_i[e, 6] = lu * fx0 * fy + lv * fy0 * (r2 + 2 * y * y)
                    J_i[e, 7] = lu * fx0 * (r2 + 2 * x * x) + lv * fy0 * fy
                    for b in range(9):
                        f = J_i[e, b]
                        for j in range(wi):
                            a[e, intrinsics_column + j] += f * K_intrinsics[b, j]
            for e in range(2):
                for j in range(wc):
                    a[e, constant_column + j] -= (
                        L[e, 0] * K_constant[corner, 0, j] + L[e, 1] * K_constant[corner, 1, j]
                    )
            weight *= share[i]
            for e in range(2):
                f = weight * r[e]
                for j in range(c):
                    grad[j] += f * a[e, j]
            root = np.sqrt(weight)
            if newton and length > k:
                # Past the threshold the loss is a cone: it bends across the residual, not along it.
                u, v = -root * r[1] / length, root * r[0] / length
                for j in range(c):
                    rows[used, j] = u * a[0, j] + v * a[1, j]
                used += 1
            else:
                for e in range(2):
                    for j in range(c):
                        rows[used, j] = root * a[e, j]
                    used += 1
        if used == 0:
            continue
        for n in range(used, 8):
            for j in range(c):
                rows[n, j] = 0.0
        # All eight rows at once: each place of H is written once.
        for u in range(c):
            f0, f1, f2, f3 = rows[0, u], rows[1, u], rows[2, u], rows[3, u]
            f4, f5, f6, f7 = rows[4, u], rows[5, u], rows[6, u], rows[7, u]
            for j in range(u, c):
                H[u, j] = ((f0 * rows[0, j] + f1 * rows[1, j]) + (f2 * rows[2, j] + f3 * rows[3, j])) + (
                    (f4 * rows[4, j] + f5 * rows[5, j]) + (f6 * rows[6, j] + f7 * rows[7, j])
                )
        k_e = epoch[i]
        for u in range(cx):
            g[k_e, x_at[u]] += grad[u]
            for j in range(u, cx):
                D[k_e, x_at[u], x_at[j]] += H[u, j]
                if j > u:
                    D[k_e, x_at[j], x_at[u]] += H[u, j]
            for j in range(cz):
                B[k_e, x_at[u], border_at[j]] += H[u, cx + j]
        for u in range(cz):
            g_z[u] += grad[cx + u]
            for j in range(u, cz):
                C[u, j] += H[cx + u, cx + j]
