"""Compiled kernels of one block-tridiagonal chain: factor, solve, selected inverse.

Plain loops over small blocks, row by row, so that the innermost one runs along contiguous memory. LAPACK's band
routines do the same in scipy and are the oracle of the tests; with their default threads they took 0.56 s where one
thread takes 0.003 s, because a block of 12 is too small to share, and the number of threads of a machine must not
decide the last bits of an answer.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", nogil=True)
def factor(D, A, count):
    """Cholesky factor in place: ``D_k`` becomes ``U_k`` (upper triangle), ``A_k`` becomes ``F_k = U_k^-T A_k``.

    Only the first ``count`` blocks are eliminated; one after them is left as ``D_k - F_k-1' F_k-1``. Returns the number
    of the first block that is not positive definite, or -1.
    """
    n, b, _ = D.shape
    for k in range(n):
        U = D[k]
        if k > 0:
            F = A[k - 1]
            for m in range(b):
                for i in range(b):
                    f = F[m, i]
                    for j in range(b):
                        U[i, j] -= f * F[m, j]
        if k == count:
            break
        for i in range(b):
            pivot = U[i, i]
            if not pivot > 0.0:
                return k
            r = 1.0 / np.sqrt(pivot)
            for j in range(i, b):
                U[i, j] *= r
            for m in range(i + 1, b):
                f = U[i, m]
                for j in range(m, b):
                    U[m, j] -= f * U[i, j]
        for i in range(b):
            for j in range(i):
                U[i, j] = 0.0
        if k < n - 1:
            F = A[k]
            for i in range(b):
                for m in range(i):
                    f = U[m, i]
                    for j in range(b):
                        F[i, j] -= f * F[m, j]
                r = 1.0 / U[i, i]
                for j in range(b):
                    F[i, j] *= r
    return -1


@njit(cache=True, error_model="numpy", nogil=True)
def eliminate(D, A, B, g, damping, D_before, W_before, count, square):
    """Factor and ``forward`` in one, of which only the sums stay: nothing but two blocks is ever written.

    Parameters
    ----------
    D, A, B, g : (n, b, b), (n - 1, b, b), (n, b, q), (n, b) arrays
        Of ``arrow.Chain``.
    damping : (n,) array
        Share of each block's own diagonal that is added to it.
    D_before, W_before : (b, b), (b, q + 1) arrays
        What those before say of the first block; in their place comes what is said of the one after ``count``.
    count : int
        Blocks that are eliminated.
    square : (q + 1, q + 1) array
        ``sum W_k' W_k`` with ``W_k = U_k^-T [B_k, -g_k]`` is added to it.

    Returns
    -------
    bad : int
        The first block that is not positive definite, or -1.
    log_det : float
        Of the eliminated blocks' factor.
    """
    n, b, q = B.shape
    U, F = np.empty((b, b)), np.empty((b, b))
    W, W_last = np.empty((b, q + 1)), np.empty((b, q + 1))
    log_det = 0.0
    for k in range(n):
        for i in range(b):
            for j in range(b):
                U[i, j] = D[k, i, j]
            U[i, i] *= 1.0 + damping[k]
            for j in range(q):
                W[i, j] = B[k, i, j]
            W[i, q] = -g[k, i]
        if k == 0:
            for i in range(b):
                for j in range(b):
                    U[i, j] += D_before[i, j]
                for j in range(q + 1):
                    W[i, j] += W_before[i, j]
        else:
            # Two rows at a time, here and below: half as much is read and written.
            for m in range(0, b - 1, 2):
                for i in range(b):
                    f, h = F[m, i], F[m + 1, i]
                    for j in range(i, b):
                        U[i, j] -= f * F[m, j] + h * F[m + 1, j]
                    for j in range(q + 1):
                        W[i, j] -= f * W_last[m, j] + h * W_last[m + 1, j]
            for m in range(b - b % 2, b):
                for i in range(b):
                    f = F[m, i]
                    for j in range(i, b):
                        U[i, j] -= f * F[m, j]
                    for j in range(q + 1):
                        W[i, j] -= f * W_last[m, j]
        if k == count:
            for i in range(b):
                for j in range(i, b):
                    D_before[i, j] = D_before[j, i] = U[i, j]
                for j in range(q + 1):
                    W_before[i, j] = W[i, j]
            break
        for i in range(b):
            pivot = U[i, i]
            if not pivot > 0.0:
                return k, log_det
            log_det += np.log(pivot)
            r = 1.0 / np.sqrt(pivot)
            for j in range(i, b):
                U[i, j] *= r
            for j in range(q + 1):
                W[i, j] *= r
            for m in range(i + 1, b):
                f = U[i, m]
                for j in range(m, b):
                    U[m, j] -= f * U[i, j]
                for j in range(q + 1):
                    W[m, j] -= f * W[i, j]
        for i in range(0, b - 1, 2):
            for u in range(q + 1):
                f, h = W[i, u], W[i + 1, u]
                if f != 0.0 or h != 0.0:
                    for j in range(u, q + 1):
                        square[u, j] += f * W[i, j] + h * W[i + 1, j]
        for i in range(b - b % 2, b):
            for u in range(q + 1):
                f = W[i, u]
                for j in range(u, q + 1):
                    square[u, j] += f * W[i, j]
        W, W_last = W_last, W
        if k < n - 1:
            for i in range(b):
                for j in range(b):
                    F[i, j] = A[k, i, j]
                for m in range(i):
                    f = U[m, i]
                    for j in range(b):
                        F[i, j] -= f * F[m, j]
                r = 1.0 / U[i, i]
                for j in range(b):
                    F[i, j] *= r
    return -1, log_det


@njit(cache=True, error_model="numpy", nogil=True)
def forward(U, F, B, count):
    """``W_k = U_k^-T (B_k - F_k-1' W_k-1)``, in place of B (n, b, r); the block after ``count`` without ``U_k^-T``."""
    n, b, r = B.shape
    for k in range(n):
        W = B[k]
        if k > 0:
            for m in range(b):
                for i in range(b):
                    f = F[k - 1, m, i]
                    for j in range(r):
                        W[i, j] -= f * B[k - 1, m, j]
        if k == count:
            break
        for i in range(b):
            for m in range(i):
                f = U[k, m, i]
                for j in range(r):
                    W[i, j] -= f * W[m, j]
            f = 1.0 / U[k, i, i]
            for j in range(r):
                W[i, j] *= f


@njit(cache=True, error_model="numpy", nogil=True)
def backward(U, F, W, count):
    """``Y_k = U_k^-1 (W_k - F_k Y_k+1)``, in place of W (n, b, r); a block after ``count`` is given as it is."""
    n, b, r = W.shape
    for k in range(count - 1, -1, -1):
        Y = W[k]
        if k < n - 1:
            for i in range(b):
                for m in range(b):
                    f = F[k, i, m]
                    for j in range(r):
                        Y[i, j] -= f * W[k + 1, m, j]
        for i in range(b - 1, -1, -1):
            for m in range(i + 1, b):
                f = U[k, i, m]
                for j in range(r):
                    Y[i, j] -= f * Y[m, j]
            f = 1.0 / U[k, i, i]
            for j in range(r):
                Y[i, j] *= f


@njit(cache=True, error_model="numpy", nogil=True)
def selected_inverse(U, F, Z, G, count):
    """``G_k = U_k^-1 F_k`` and ``Z_k = U_k^-1 U_k^-T + G_k Z_k+1 G_k'``, into Z (n, b, b) and G (n - 1, b, b).

    A block of Z after ``count`` is given.
    """
    n, b, _ = U.shape
    V = np.zeros((b, b))
    T = np.zeros((b, b))
    for k in range(count - 1, -1, -1):
        V[:] = 0.0  # U_k^-1
        for i in range(b - 1, -1, -1):
            V[i, i] = 1.0
            for m in range(i + 1, b):
                f = U[k, i, m]
                for j in range(m, b):
                    V[i, j] -= f * V[m, j]
            f = 1.0 / U[k, i, i]
            for j in range(i, b):
                V[i, j] *= f
        for i in range(b):
            for j in range(i, b):
                s = 0.0
                for m in range(j, b):
                    s += V[i, m] * V[j, m]
                Z[k, i, j] = s
        if k < n - 1:
            for i in range(b):
                for j in range(b):
                    G[k, i, j] = 0.0
                    T[i, j] = 0.0
                for m in range(i, b):
                    f = V[i, m]
                    for j in range(b):
                        G[k, i, j] += f * F[k, m, j]
                for m in range(b):
                    f = G[k, i, m]
                    for j in range(b):
                        T[i, j] += f * Z[k + 1, m, j]
            for i in range(b):
                for j in range(i, b):
                    s = 0.0
                    for m in range(b):
                        s += T[i, m] * G[k, j, m]
                    Z[k, i, j] += s
        for i in range(b):
            for j in range(i):
                Z[k, i, j] = Z[k, j, i]


@njit(cache=True, error_model="numpy", nogil=True)
def gram(A, B):
    """``A' B`` of two tall matrices (n, p), (n, q) whose product is known to be symmetric in its first p columns."""
    n, p = A.shape
    q = B.shape[1]
    out = np.zeros((p, q))
    for k in range(n):
        for i in range(p):
            f = A[k, i]
            if f != 0.0:
                for j in range(i, q):
                    out[i, j] += f * B[k, j]
    for i in range(p):
        for j in range(i):
            out[i, j] = out[j, i]
    return out
