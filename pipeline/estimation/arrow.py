"""Linear algebra of the arrow: block-tridiagonal chains with a shared border of statics.

The equations stand in ``docs/equations.md``. Each chain is factored once as a band matrix by LAPACK; the selected inverse
is a backward recursion over its blocks. A dense inverse of 20,000 poses would need 115 GB; here everything
is linear in the number of epochs. This file knows no poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg


@dataclass(frozen=True, eq=False)
class Chain:
    """Normal equations of one chain, linearised: ``H_xx``, its part of ``H_xs``, and the gradient."""

    D: np.ndarray
    """(E, b, b) diagonal blocks."""
    A: np.ndarray
    """(E - 1, b, b) upper blocks ``A_k,k+1``."""
    g: np.ndarray
    """(E, b) gradient."""
    B: np.ndarray
    """(E, b, q) border."""
    columns: np.ndarray
    """(q,) which of the statics the border's columns belong to."""


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky factor of one chain, ``H = U' U``, in LAPACK's upper band storage."""

    band: np.ndarray
    """(2b, E b)."""
    epochs: int
    size: int

    def solve(self, rhs):
        """``H^-1 rhs``: (E, b, r) from (E, b, r)."""
        flat = rhs.reshape(self.epochs * self.size, -1)
        out = scipy.linalg.cho_solve_banded((self.band, False), flat, check_finite=False)
        return out.reshape(rhs.shape)

    def blocks(self):
        """``U_k`` (E, b, b) upper triangular and ``F_k`` (E - 1, b, b), the factor's blocks right of it."""
        E, b = self.epochs, self.size
        U, F = np.zeros((E, b, b)), np.zeros((max(E - 1, 0), b, b))
        u = self.band.shape[0] - 1
        for r in range(b):
            for c in range(r, b):
                U[:, r, c] = self.band[u + r - c, c::b]
            for c in range(b):
                F[:, r, c] = self.band[u + r - b - c, b + c :: b]
        return U, F


def factor(D, A) -> Factor:
    """Cholesky factor of a block-tridiagonal matrix.

    Parameters
    ----------
    D : (E, b, b) array
    A : (E - 1, b, b) array
        Upper blocks ``A_k,k+1``.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    """
    E, b, _ = D.shape
    u = 2 * b - 1
    band = np.zeros((u + 1, E * b))
    for r in range(b):
        for c in range(r, b):
            band[u + r - c, c::b] = D[:, r, c]
        for c in range(b):
            band[u + r - b - c, b + c :: b] = A[:, r, c]
    return Factor(scipy.linalg.cholesky_banded(band, overwrite_ab=True, check_finite=False), E, b)


def selected_inverse(factored: Factor):
    """Diagonal blocks of the inverse: ``Z_k = U_k^-1 U_k^-T + G_k Z_k+1 G_k'`` with ``G_k = U_k^-1 F_k``.

    Returns
    -------
    Z : (E, b, b) array
    G : (E - 1, b, b) array
        Neighbouring blocks follow as ``Z_k,k+1 = -G_k Z_k+1``.
    """
    U, F = factored.blocks()
    U_inv = np.linalg.inv(U)
    Z = U_inv @ np.swapaxes(U_inv, -1, -2)
    G = U_inv[:-1] @ F
    G_t = np.ascontiguousarray(np.swapaxes(G, -1, -2))
    for k in range(len(Z) - 2, -1, -1):
        Z[k] += G[k] @ Z[k + 1] @ G_t[k]
    return 0.5 * (Z + np.swapaxes(Z, -1, -2)), G


@dataclass(frozen=True, eq=False)
class Step:
    """Solution of the arrow."""

    dx: tuple[np.ndarray, ...]
    """(E, b) per chain."""
    dz: np.ndarray
    """(p,)."""
    Y: tuple[np.ndarray, ...]
    """(E, b, q) per chain, ``H_xx^-1 H_xs``: how the states follow the statics."""
    S: np.ndarray
    """(p, p) information of the statics once the states are eliminated; its inverse is their covariance."""
    factors: tuple[Factor, ...]


def solve(chains, C, g_z, damping=None) -> Step:
    """Gauss-Newton step of the whole network.

    Parameters
    ----------
    chains : sequence of Chain
    C : (p, p) array
        Information of the statics with the states held fixed, their priors included.
    g_z : (p,) array
        Gradient.
    damping : (E,) array, optional
        Share of each epoch's own diagonal that is added to it; never in the covariance pass.

    Raises
    ------
    numpy.linalg.LinAlgError
        Something is held by nothing at all.
    """
    S, b = C.copy(), -g_z
    factors, particular, Y = [], [], []
    for chain in chains:
        D = chain.D
        if damping is not None:
            D = D.copy()
            i = np.arange(D.shape[-1])
            D[:, i, i] *= 1 + damping[:, None]
        factored = factor(D, chain.A)
        both = factored.solve(np.concatenate([chain.B, -chain.g[..., None]], axis=-1))
        Y_c, x_c = both[..., :-1], both[..., -1]
        q = len(chain.columns)
        border = chain.B.reshape(-1, q)
        S[np.ix_(chain.columns, chain.columns)] -= border.T @ Y_c.reshape(-1, q)
        b[chain.columns] -= border.T @ x_c.ravel()
        factors.append(factored)
        particular.append(x_c)
        Y.append(Y_c)
    S = 0.5 * (S + S.T)
    dz = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), b) if len(b) else b
    dx = tuple(x - y @ dz[chain.columns] for x, y, chain in zip(particular, Y, chains, strict=True))
    return Step(dx, dz, tuple(Y), S, tuple(factors))
