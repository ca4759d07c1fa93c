"""Whether the corners of one view err together: views against one another, by leaving each out.

The covariance of an adjustment takes corners to err each for itself. On real boards they do not: a board bends in the
hand, a lens refocuses, a rolling shutter shears a moving board. Each view then pulls the lens its own way, further than
its corners' scatter explains, and the plain covariance is too small. Leaving out view v moves the intrinsics by

    d_v = (S - S_v)^-1 g_v,     cov g_v = sigma0² (S_v - S_v S^-1 S_v)  if all corners err for themselves

with S_v its information and g_v its part of the gradient at the solution. The sum of ``d' S d`` over what that would be
is the factor by which the covariance is too small on the whole; where it is beyond chance, the covariance grows by it,
and in directions in which views disagree more than that, by what they disagree (the jackknife's covariance). The
jackknife alone would not do: from ten differences it knows nine directions, and little of each.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

CHANCE = 0.01
"""Probability of the factor in a recording without shared errors, below which it counts."""


def with_shared_errors(information: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, float]:
    """The covariance with what the corners of a view share taken in.

    Parameters
    ----------
    information : (v, s, s) array
        Of each view on the statics, its pose reduced out, in units of the residuals' variance.
    gradient : (v, s) array
        Of each view at the solution, likewise reduced and in the same unit; they sum to zero.

    Returns
    -------
    covariance : (s, s) array
        The plain one, ``S^-1``, where what views disagree by may be chance.
    factor : float
        By which it grew on the whole; at least 1.
    """
    S = information.sum(axis=0)
    white = np.linalg.inv(np.linalg.cholesky(S))
    plain = white.T @ white
    # In these coordinates S is the identity, and d' S d the plain square.
    each = white @ information @ white.T
    pull = gradient @ white.T
    others = np.eye(len(S)) - each
    if np.min(np.linalg.eigvalsh(others)) < 1e-6:
        return plain, 1.0  # one view alone tells some direction: there is nothing to compare it with
    left_out = np.linalg.inv(others)
    moved = (left_out @ pull[..., None])[..., 0]
    expected = left_out @ (each - each @ each) @ left_out
    mean = np.trace(expected, axis1=1, axis2=2).sum()
    spread = np.sum(expected * np.swapaxes(expected, 1, 2))
    factor = float(np.sum(moved**2) / mean)
    # A sum of squares with unequal weights is about a chi-square of so many degrees (Satterthwaite).
    degrees = mean**2 / spread
    if factor <= chi2.isf(CHANCE, degrees) / degrees:
        return plain, 1.0
    # Expected without shared errors: the identity.
    jackknife = moved.T @ moved * len(S) / mean
    size, direction = np.linalg.eigh(jackknife)
    grown = (direction * np.maximum(size, factor)) @ direction.T
    return white.T @ grown @ white, factor
