"""The arrow written out as one dense matrix: what the block algebra must agree with."""

import numpy as np


def assemble(chains, C, g_z):
    """Dense normal matrix and gradient; order: chains, epoch by epoch, then the statics."""
    sizes = [c.g.size for c in chains]
    starts = np.cumsum([0, *sizes])
    n, p = starts[-1], len(g_z)
    H, g = np.zeros((n + p, n + p)), np.zeros(n + p)
    for chain, start in zip(chains, starts, strict=False):
        E, b = chain.g.shape
        for k in range(E):
            a = start + k * b
            H[a : a + b, a : a + b] = chain.D[k]
            if k + 1 < E:
                H[a : a + b, a + b : a + 2 * b] = chain.A[k]
                H[a + b : a + 2 * b, a : a + b] = chain.A[k].T
            H[a : a + b, n + chain.columns] = chain.B[k]
            H[n + chain.columns, a : a + b] = chain.B[k].T
            g[a : a + b] = chain.g[k]
    H[n:, n:], g[n:] = C, g_z
    return H, g, starts


def inverse(H):
    """Inverse of a positive definite matrix, balanced first so that units do not cost digits."""
    d = 1 / np.sqrt(np.diagonal(H))
    return np.linalg.inv(H * d[:, None] * d[None]) * d[:, None] * d[None]
