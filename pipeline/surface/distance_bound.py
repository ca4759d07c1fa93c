"""A lower bound of the distance between two places that are both known only so well.

The estimated distance between two places is longer than the true one more often than not: errors sideways lengthen
it whichever way they go. Where the distance is many sigmas that is nothing, and the bound is the distance less 1.645
sigmas. For a cable whose place is known to 100 mm it is everything: the edge that truly cut it is estimated 125 mm
away on average, and in 26 of 100 cases further than 1.645 sigmas, which would then exclude the strike.

So the bound is what a test leaves: the smallest true distance at which an estimate as far away as this one, or
further, has a chance of 5 in 100. Errors are normal, with one sigma along the line of approach and the largest sigma
across it. A third direction, along the buried line, changes no distance.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit

CONFIDENCE = 0.95
"""One-sided."""
_QUANTILE = 1.6448536269514722
"""Of the normal distribution at that confidence: what the bound comes to where the distance is many sigmas."""
_RATIO = np.arange(0.0, 5.01, 0.25)
_TRUE = np.arange(0.0, 10.01, 0.1)
_NODES = 48
_HALVINGS = 40
_FAR = 6.0


@lru_cache(maxsize=1)
def quantiles() -> np.ndarray:
    """Estimated distance that 95 in 100 stay below, over sigma along; rows sideways sigma, columns true distance.

    Returns
    -------
    (r, d) array
        Over sigma: row i for a sideways sigma of ``0.25 i``, column j for a true distance of ``0.1 j``. Between columns
        it bends upwards, so a straight line read backwards gives a distance that is rather too small.
    """
    from scipy.special import ndtr

    node, weight = np.polynomial.legendre.leggauss(_NODES)
    angle = 0.25 * np.pi * (node + 1)
    ratio, true = _RATIO[:, None], _TRUE[None, :]
    low = np.zeros((len(_RATIO), len(_TRUE)))
    high = low + true + _FAR * np.maximum(ratio, 1.0)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        # Across, z runs to where the circle ends; z = reach sin(angle) takes the root out of the integrand's end.
        reach = np.minimum(_FAR, middle / np.maximum(ratio, 1e-9))[..., None]
        z = reach * np.sin(angle)
        half = np.sqrt(np.maximum(middle[..., None] ** 2 - (ratio[..., None] * z) ** 2, 0.0))
        inside = ndtr(half - true[..., None]) - ndtr(-half - true[..., None])
        density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * reach * np.cos(angle) * 0.25 * np.pi * weight
        too_far = 2 * np.sum(inside * density, axis=-1) > CONFIDENCE
        high, low = np.where(too_far, middle, high), np.where(too_far, low, middle)
    return 0.5 * (low + high)


@njit(cache=True, nogil=True)
def lower_bound(distance, sigma, sideways, table):  # pragma: no cover - compiled
    """Distance that the true one is not below, with 95 % confidence; 0 where nothing is excluded.

    Parameters
    ----------
    distance : float
        As estimated, metres.
    sigma : float
        Standard deviation along the line of approach.
    sideways : float
        The largest across it.
    table : (r, d) array
        Of `quantiles`.
    """
    rows, columns = table.shape
    sigma = max(sigma, sideways / (0.25 * (rows - 1)))
    if sigma <= 0.0:
        return distance
    x = distance / sigma
    place = min(4.0 * sideways / sigma, rows - 1.0)
    row = min(int(place), rows - 2)
    share = place - row
    first, last = 0, columns - 1
    if x <= table[row, 0] * (1 - share) + table[row + 1, 0] * share:
        return 0.0
    end = table[row, last] * (1 - share) + table[row + 1, last] * share
    if x >= end:
        # Far out the excess over 1.645 falls as one over the distance.
        far = 0.1 * last
        excess = end - far - _QUANTILE
        return 0.5 * (x - _QUANTILE + np.sqrt((x - _QUANTILE) ** 2 - 4.0 * far * excess)) * sigma
    while last - first > 1:
        middle = (first + last) // 2
        if table[row, middle] * (1 - share) + table[row + 1, middle] * share <= x:
            first = middle
        else:
            last = middle
    below = table[row, first] * (1 - share) + table[row + 1, first] * share
    above = table[row, last] * (1 - share) + table[row + 1, last] * share
    return 0.1 * (first + (x - below) / (above - below)) * sigma
