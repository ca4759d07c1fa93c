"""The floor of a cell from its passes, without the bias of taking the lowest of many noisy ones.

The floor is the lowest place where the edge truly was. The lowest *estimate* lies below it: of m passes at one
level with noise s, by s times the expected minimum of m standard normals (1.03 s for four, 1.54 s for ten). A
plug-in correction, the expected minimum of fresh noise on top of the estimates, mends less than half of it,
because the estimates already are spread by the noise. So the spread of the true passes above the floor is part of
the model:

    one pass, no telling which, was at the floor f; every other one was higher by x, drawn from a density g
    estimate k = true height k + noise of standard deviation s_k, independent from pass to pass

g is shared by all cells of a job and found from them (deconvolution by expectation maximisation over a grid of x);
f has no prior. What is returned is the mean and the standard deviation of f given the passes. One pass alone
gives itself back; passes far above the lowest say nothing and are left out; where all passes lie within their
noise, f is about their mean. An exponential g with one parameter was tried first: it over-corrected by up to 1.5
sigma where passes scatter like a normal, whose density rises away from its lower end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

_WINDOW = 6.0
"""Passes more than this many sigmas above the lowest estimate are left out: they cannot have been the floor."""
_REACH = 4.5
"""The floor is looked for this many sigmas around the lowest estimate."""
_STEPS = 45
_MOST = 64
"""Passes of one cell that are used, the lowest ones; a bucket parked over a cell for a day makes no more."""
_EXCESS = np.array([0.0, 0.75, 1.5, 3.0, 6.0])
"""g is a mixture of uniform densities from 0 to each of these, in median sigmas; the first is all at the floor."""
_ROUNDS = 40
_RELAXATION = 1.8
_PRIOR = 0.02
"""Share of the evidence that says nothing (a flat g): keeps few cells from inventing a sharp g."""
_CELLS_FOR_SPREAD = 800
_TINY_SIGMA_M = 1e-6


@dataclass(frozen=True)
class Floor:
    """Floor of each cell."""

    height: np.ndarray
    """(cells,) metres; nan without a pass."""
    sigma_own: np.ndarray
    """(cells,) standard deviation of the own part, metres."""
    lowest: np.ndarray
    """(cells,) the lowest estimate as it was, metres."""
    lowest_pass: np.ndarray
    """(cells,) int64 index of that pass; -1 without a pass."""
    passes_near: np.ndarray
    """(cells,) int32: passes close enough to the lowest to have been the floor."""
    excess_m: np.ndarray
    """(j,) heights above the floor at which other passes were, metres; empty where no cell had two near passes."""
    excess_share: np.ndarray
    """(j,) the estimated share of passes at each: the density g."""


def lowest_floor(first: np.ndarray, height: np.ndarray, sigma: np.ndarray, corrected: bool = True) -> Floor:
    """Floor of cells as the lower envelope of their passes.

    Parameters
    ----------
    first : (cells + 1,) int array
        Passes of cell k are ``first[k]:first[k + 1]``.
    height : (p,) array
        Estimated heights of the passes, metres.
    sigma : (p,) array
        Own standard deviation of each, independent between passes, metres.
    corrected : bool
        False returns the plain minimum and its own sigma: for comparison only.

    Returns
    -------
    Floor
    """
    sigma = np.maximum(sigma, _TINY_SIGMA_M)
    lowest_pass, near = _lowest(first, height, sigma)
    there = lowest_pass >= 0
    lowest = np.where(there, height[lowest_pass] if len(height) else np.nan, np.nan)
    floor = lowest.copy()
    sigma_own = np.where(there, sigma[lowest_pass] if len(height) else np.nan, np.nan)
    excess = share = np.zeros(0)
    several = np.flatnonzero(near > 1)
    if corrected and len(several):
        excess = _EXCESS * float(np.median(sigma[lowest_pass[several]]))
        # Every n-th cell, not the first ones: those are the start of the trench.
        sample = several[:: max(1, len(several) // _CELLS_FOR_SPREAD)]
        share = np.full(len(excess), 1 / len(excess))
        for _ in range(_ROUNDS):
            claimed = _posterior(sample, first, height, sigma, lowest, excess, share, floor, sigma_own)
            claimed += _PRIOR * claimed.sum() / len(claimed)
            # Over-relaxed: the plain step needs hundreds of rounds where all passes are at the floor.
            share = share * (claimed / (share * claimed.sum())) ** _RELAXATION
            share /= share.sum()
        _posterior(several, first, height, sigma, lowest, excess, share, floor, sigma_own)
    return Floor(floor, sigma_own, lowest, lowest_pass, near, excess, share)


def last_floor(first: np.ndarray, height: np.ndarray, sigma: np.ndarray) -> Floor:
    """Floor of cells as their last pass, for material that is placed and not dug; arguments as `lowest_floor`."""
    sigma = np.maximum(sigma, _TINY_SIGMA_M)
    lowest_pass, _ = _lowest(first, height, sigma)
    there = first[1:] > first[:-1]
    last = np.where(there, first[1:] - 1, -1)
    if not len(height):
        nothing = np.full(len(there), np.nan)
        return Floor(nothing, nothing, nothing, last, there.astype(np.int32), np.zeros(0), np.zeros(0))
    return Floor(
        height=np.where(there, height[last], np.nan),
        sigma_own=np.where(there, sigma[last], np.nan),
        lowest=np.where(there, height[lowest_pass], np.nan),
        lowest_pass=last,
        passes_near=there.astype(np.int32),
        excess_m=np.zeros(0),
        excess_share=np.zeros(0),
    )


@njit(cache=True, nogil=True)
def _lowest(first, height, sigma):  # pragma: no cover - compiled
    cells = len(first) - 1
    lowest = np.full(cells, -1, np.int64)
    near = np.zeros(cells, np.int32)
    for c in range(cells):
        at = -1
        for p in range(first[c], first[c + 1]):
            if at < 0 or height[p] < height[at]:
                at = p
        lowest[c] = at
        for p in range(first[c], first[c + 1]):
            if height[p] - height[at] <= _WINDOW * max(sigma[p], sigma[at]):
                near[c] += 1
    return lowest, near


@njit(cache=True, nogil=True)
def _gather(first, last, height, sigma, lowest, y, s):  # pragma: no cover - compiled
    """Heights above the lowest, and sigmas, of the passes that count; how many, and their largest sigma."""
    n = 0
    largest = 0.0
    base = 0.0
    for p in range(first, last):
        if height[p] == lowest:
            base = max(base, sigma[p])
    for p in range(first, last):
        if height[p] - lowest <= _WINDOW * max(sigma[p], base) and n < _MOST:
            y[n], s[n] = height[p] - lowest, sigma[p]
            largest = max(largest, sigma[p])
            n += 1
    return n, largest


@njit(cache=True, nogil=True)
def _density(x, s, reach):  # pragma: no cover - compiled
    """Density of an estimate x above the floor whose truth is uniform from 0 to reach (0: exactly there)."""
    if reach == 0.0:
        x /= s
        return math.exp(-0.5 * x * x) / (s * 2.5066282746310002)
    r = 1.0 / (s * 1.4142135623730951)
    return 0.5 * (math.erf(x * r) - math.erf((x - reach) * r)) / reach


@njit(cache=True, nogil=True)
def _likelihood(f, y, s, n, excess, share, above, at):  # pragma: no cover - compiled
    """Log likelihood of the floor f; leaves per pass the densities of `above` the floor and of `at` it."""
    total = 0.0
    ratio = 0.0
    for k in range(n):
        x = y[k] - f
        r = 1.0 / (s[k] * 1.4142135623730951)
        at[k] = math.exp(-x * x * r * r) * r / 1.7724538509055159
        d = share[0] * at[k]
        erf_x = math.erf(x * r)
        for j in range(1, len(excess)):
            d += share[j] * 0.5 * (erf_x - math.erf((x - excess[j]) * r)) / excess[j]
        above[k] = max(d, 1e-200)
        total += math.log(above[k])
        ratio += at[k] / above[k]
    return total + math.log(max(ratio, 1e-200))


@njit(cache=True, nogil=True)
def _posterior(
    cells, first, height, sigma, lowest, excess, share, floor, sigma_own
):  # pragma: no cover - compiled
    """Fills `floor` and `sigma_own` of the cells; returns the expected number of passes in each part of g."""
    y, s = np.empty(_MOST), np.empty(_MOST)
    above, at = np.empty(_MOST), np.empty(_MOST)
    value = np.empty(_STEPS + 1)
    claimed = np.zeros(len(excess))
    for c in cells:
        n, largest = _gather(first[c], first[c + 1], height, sigma, lowest[c], y, s)
        step = 2.0 * _REACH * largest / _STEPS
        best = -1e300
        for i in range(_STEPS + 1):
            value[i] = _likelihood(-_REACH * largest + i * step, y, s, n, excess, share, above, at)
            best = max(best, value[i])
        mass = mean = square = 0.0
        for i in range(_STEPS + 1):
            f = -_REACH * largest + i * step
            value[i] = math.exp(value[i] - best)
            mass += value[i]
            mean += value[i] * f
            square += value[i] * f * f
        mean /= mass
        floor[c] = lowest[c] + mean
        sigma_own[c] = math.sqrt(max(square / mass - mean * mean, 0.0))
        for i in range(_STEPS + 1):
            weight = value[i] / mass
            if weight < 1e-3:
                continue
            f = -_REACH * largest + i * step
            _likelihood(f, y, s, n, excess, share, above, at)
            ratio = 0.0
            for k in range(n):
                ratio += at[k] / above[k]
            for k in range(n):
                # The chance that pass k is not the one at the floor, shared out over the parts of g.
                other = weight * (1.0 - at[k] / above[k] / max(ratio, 1e-200)) / above[k]
                for j in range(len(excess)):
                    claimed[j] += other * share[j] * _density(y[k] - f, s[k], excess[j])
    return claimed
