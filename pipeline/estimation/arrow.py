"""Linear algebra of the arrow: block-tridiagonal chains with a shared border of statics.

The equations stand in ``docs/equations.md``. Each chain is factored once, the selected inverse is a backward
recursion over its blocks. A dense inverse of 20,000 poses would need 115 GB; here everything is linear in the number
of epochs. This file knows no poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from pipeline.estimation import blocks


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
    """Cholesky factor ``H = U' U`` of one chain, by blocks."""

    U: np.ndarray
    """(E, b, b) upper triangles ``U_k``."""
    F: np.ndarray
    """(E - 1, b, b) blocks ``F_k`` of U right of them."""

    def forward(self, rhs):
        """``U^-T rhs``: (E, b, r) from (E, b, r)."""
        out = np.ascontiguousarray(rhs).copy()
        blocks.forward(self.U, self.F, out, len(self.U))
        return out

    def backward(self, rhs):
        """``U^-1 rhs``: (E, b, r) from (E, b, r)."""
        out = np.ascontiguousarray(rhs).copy()
        blocks.backward(self.U, self.F, out, len(self.U))
        return out


def factor(D, A, damping=None) -> Factor:
    """Cholesky factor of a block-tridiagonal matrix.

    Parameters
    ----------
    D : (E, b, b) array
        Diagonal blocks.
    A : (E - 1, b, b) array
        Upper blocks ``A_k,k+1``.
    damping : (E,) array, optional
        Share of each epoch's own diagonal that is added to it.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite; the message names the epoch.
    """
    U, F = D.copy(), A.copy()
    if damping is not None:
        i = np.arange(D.shape[-1])
        U[:, i, i] *= 1 + damping[:, None]
    bad = blocks.factor(U, F, len(U))
    if bad >= 0:
        raise np.linalg.LinAlgError(f"block {bad} is not positive definite")
    return Factor(U, F)


def selected_inverse(factored: Factor):
    """Diagonal blocks of the inverse: ``Z_k = U_k^-1 U_k^-T + G_k Z_k+1 G_k'`` with ``G_k = U_k^-1 F_k``.

    Returns
    -------
    Z : (E, b, b) array
    G : (E - 1, b, b) array
        Neighbouring blocks follow as ``Z_k,k+1 = -G_k Z_k+1``.
    """
    Z, G = np.empty_like(factored.U), np.empty_like(factored.F)
    blocks.selected_inverse(factored.U, factored.F, Z, G, len(Z))
    return Z, G


@dataclass(frozen=True, eq=False)
class Step:
    """Solution of the arrow."""

    dx: tuple[np.ndarray, ...]
    """(E, b) per chain."""
    dz: np.ndarray
    """(p,)."""
    S: np.ndarray
    """(p, p) information of the statics once the states are eliminated; its inverse is their covariance."""
    factors: tuple[Factor, ...]
    W: tuple[np.ndarray, ...]
    """(E, b, q) per chain, ``U^-T H_xs``."""


def solve(chains, C, g_z, damping=None) -> Step:
    """Gauss-Newton step of the whole network.

    Parameters
    ----------
    chains : sequence of Chain
        Independent of each other given the statics.
    C : (p, p) array
        Information of the statics with the states held fixed, their priors included.
    g_z : (p,) array
        Gradient.
    damping : (E,) array, optional
        See ``factor``; never in the covariance pass.

    Raises
    ------
    numpy.linalg.LinAlgError
        Something is held by nothing at all.
    """
    S, b = C.copy(), -g_z
    factors, forwards = [], []
    for chain in chains:
        factored = factor(chain.D, chain.A, damping)
        Wy = factored.forward(np.concatenate([chain.B, -chain.g[..., None]], axis=-1))
        flat = Wy.reshape(-1, Wy.shape[-1])
        square = blocks.gram(flat[:, :-1], flat)
        S[np.ix_(chain.columns, chain.columns)] -= square[:, :-1]
        b[chain.columns] -= square[:, -1]
        factors.append(factored)
        forwards.append(Wy)
    S = 0.5 * (S + S.T)
    W, y = [Wy[..., :-1] for Wy in forwards], [Wy[..., -1:] for Wy in forwards]
    dx, dz = _back(chains, factors, W, S, y, b[:, None])
    return Step(tuple(x[..., 0] for x in dx), dz[:, 0], S, tuple(factors), tuple(W))


def solve_again(step: Step, chains, rhs_x, rhs_z):
    """``H^-1`` times other right-hand sides, with the factors of a step.

    Parameters
    ----------
    step : Step
        Of ``solve``.
    chains : sequence of Chain
        Those that it solved.
    rhs_x : sequence of (E, b, r) arrays
        Per chain.
    rhs_z : (p, r) array
        Of the statics.

    Returns
    -------
    dx : list of (E, b, r) arrays
    dz : (p, r) array
    """
    y = [factored.forward(rhs) for factored, rhs in zip(step.factors, rhs_x, strict=True)]
    b = rhs_z.copy()
    for chain, W, y_c in zip(chains, step.W, y, strict=True):
        b[chain.columns] -= np.tensordot(W, y_c, axes=([0, 1], [0, 1]))
    return _back(chains, step.factors, step.W, step.S, y, b)


def _back(chains, factors, W, S, y, b):
    """States and statics from what is left of the right-hand sides once the states are eliminated."""
    dz = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), b) if len(b) else b
    parts = zip(chains, factors, W, y, strict=True)
    return [factored.backward(y_c - W_c @ dz[chain.columns]) for chain, factored, W_c, y_c in parts], dz


def border(step: Step) -> tuple[np.ndarray, ...]:
    """``Y = H_xx^-1 H_xs`` of each chain, (E, b, q): how the states follow the statics, ``dx = -Y dz``."""
    return tuple(factored.backward(W) for factored, W in zip(step.factors, step.W, strict=True))
