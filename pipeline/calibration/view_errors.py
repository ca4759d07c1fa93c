"""Whether the corners of one view err together: views against one another, by leaving each out.

The covariance of an adjustment takes corners to err each for itself. On real boards they do not: a board bends in the
hand, a lens refocuses, a rolling shutter shears a moving board. Each view then pulls the lens its own way, further than
its corners' scatter explains, and the plain covariance is too small by the root of that. Leaving out view v moves the
intrinsics by

    d_v = (S - S_v)^-1 g_v,     cov g_v = sigma0² (S_v - S_v S^-1 S_v)  if all corners err for themselves

with S_v its information and g_v its part of the gradient at the solution. `shared_factor` is the sum of ``d' S d`` over
what that would be; beyond chance it multiplies the covariance. It is the jackknife, brought to one number: with ten
views a whole covariance from ten differences would say more of chance than of the lens.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

CHANCE = 0.01
"""Probability of the factor in a recording without shared errors, below which it counts."""


def shared_factor(information: np.ndarray, gradient: np.ndarray) -> float:
    """By how much the covariance must grow for what the corners of a view share; 1 where that may be chance.

    Parameters
    ----------
    information : (v, s, s) array
        Of each view on the statics, its pose reduced out, in units of the residuals' variance.
    gradient : (v, s) array
        Of each view at the solution, likewise reduced and in the same unit; they sum to zero.

    Returns
    -------
    float
        Of the covariance, so that its root is of the standard deviations; at least 1.
    """
    S = information.sum(axis=0)
    L = np.linalg.cholesky(S)
    white = np.linalg.inv(L)
    # In these coordinates S is the identity, and d' S d the plain square.
    each = white @ information @ white.T
    pull = gradient @ white.T
    others = np.eye(len(S)) - each
    if np.min(np.linalg.eigvalsh(others)) < 1e-6:
        return 1.0  # one view alone tells some direction: there is nothing to compare it with
    left_out = np.linalg.inv(others)
    moved = (left_out @ pull[..., None])[..., 0]
    expected = left_out @ (each - each @ each) @ left_out
    mean = np.trace(expected, axis1=1, axis2=2).sum()
    spread = np.sum(expected * np.swapaxes(expected, 1, 2))
    factor = float(np.sum(moved**2) / mean)
    # A sum of squares with unequal weights is about a chi-square of so many degrees (Satterthwaite).
    degrees = mean**2 / spread
    return factor if factor > chi2.isf(CHANCE, degrees) / degrees else 1.0
