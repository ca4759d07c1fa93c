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

from pipeline.surface.one_sweep import sweeps_of

_WINDOW = 6.0
"""Passes more than this many sigmas above the lowest estimate are left out: they cannot have been the floor."""
_REACH = 4.5
"""The floor is looked for this many sigmas around the lowest estimate."""
_STEPS = 45
_MOST = 24
"""Passes of one cell that are used, the lowest ones: the expected minimum hardly moves beyond two dozen."""
_CLASS = 1.1
_BINS_PER_SIGMA = 20
_LEFT, _RIGHT = -9.0, 20.0
"""Densities of excess plus noise are tabulated per class of sigma (10 % wide) from here to there, in sigmas."""
_EXCESS = np.array([0.0, 0.75, 1.5, 3.0, 6.0])
"""g is a mixture of uniform densities from 0 to each of these, in median sigmas; the first is all at the floor."""
_ROUNDS = 120
_RELAXATION = 1.8
_PRIOR_SWEEPS = 3
"""So many sweeps are added to those that were seen, shared out by the roots of the parts' heights: a few dozen sweeps,
each with one error in hundreds of cells, would invent a g that is sharp at the floor. With half a percent of the
cells' evidence in place of them, and alike for each part however narrow, the floor came out 0.4 of its own sigmas too
high over 60 drawn trenches. Shared out by the heights themselves it is freer still there (0.05 in place of 0.2), and
0.3 sigmas too low where three finishing passes lie within their noise."""
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


def lowest_floor(
    first: np.ndarray,
    height: np.ndarray,
    sigma: np.ndarray,
    corrected: bool = True,
    time_ns: np.ndarray | None = None,
) -> Floor:
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
    time_ns : (p,) int array, optional
        When each pass was: those of one sweep err alike in all cells. Without it they are taken as independent.

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
        prior = _PRIOR_SWEEPS / _sweeps(sample, first, time_ns) * np.sqrt(excess) / np.sqrt(excess).sum()
        share = np.full(len(excess), 1 / len(excess))
        smallest = float(sigma.min())
        parts = _tables(excess, smallest, float(sigma.max()))
        arguments = (first, height, sigma, lowest, smallest)
        for _ in range(_ROUNDS):
            claimed = _posterior(sample, *arguments, parts, share, floor, sigma_own)
            claimed += prior * claimed.sum()
            # Over-relaxed: the plain step needs hundreds of rounds where all passes are at the floor.
            share = share * (claimed / (share * claimed.sum())) ** _RELAXATION
            share /= share.sum()
        _posterior(several, *arguments, parts, share, floor, sigma_own)
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


def _sweeps(cells: np.ndarray, first: np.ndarray, time_ns: np.ndarray | None) -> int:
    """How many sweeps crossed some cells."""
    count = first[cells + 1] - first[cells]
    if time_ns is None:
        return int(count.sum())
    passes = np.repeat(first[cells] - np.cumsum(count) + count, count) + np.arange(count.sum())
    return len(sweeps_of(np.ones(len(passes)), time_ns[passes]))


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


def _tables(excess: np.ndarray, smallest: float, largest: float) -> np.ndarray:
    """Density, times sigma, of an estimate that lies u sigmas above the floor, its truth uniform from 0 to an excess.

    Returns (classes, bins, parts): classes of sigma from `smallest` up, u from `_LEFT` in steps of
    1 / `_BINS_PER_SIGMA`. Only the density of passes above the floor is read from here, so rounding sigma to a class
    changes nothing that is claimed about the floor itself.
    """
    from scipy.special import ndtr

    classes = int(np.log(largest / smallest) / np.log(_CLASS)) + 2
    sigma = smallest * _CLASS ** np.arange(classes)
    u = _LEFT + np.arange(round((_RIGHT - _LEFT) * _BINS_PER_SIGMA) + 2) / _BINS_PER_SIGMA
    width = excess[None, None, 1:] / sigma[:, None, None]
    spread = (ndtr(u)[None, :, None] - ndtr(u[None, :, None] - width)) / width
    normal = np.broadcast_to((np.exp(-0.5 * u**2) / np.sqrt(2 * np.pi))[None, :, None], (classes, len(u), 1))
    return np.ascontiguousarray(np.concatenate([normal, spread], axis=2))


@njit(cache=True, nogil=True)
def _gather(begin, end, height, sigma, lowest, smallest, y, s, cls):  # pragma: no cover - compiled
    """Heights above the lowest, sigmas and their classes of the passes that count; how many, and the largest sigma."""
    base = 0.0
    for p in range(begin, end):
        if height[p] == lowest:
            base = max(base, sigma[p])
    n = 0
    largest = 0.0
    for p in range(begin, end):
        above = height[p] - lowest
        if above > _WINDOW * max(sigma[p], base):
            continue
        if n == _MOST and above >= y[n - 1]:
            continue
        at = n if n < _MOST else n - 1
        while at > 0 and y[at - 1] > above:
            y[at], s[at], cls[at] = y[at - 1], s[at - 1], cls[at - 1]
            at -= 1
        y[at], s[at] = above, sigma[p]
        cls[at] = int(np.log(sigma[p] / smallest) / np.log(_CLASS) + 0.5)
        largest = max(largest, sigma[p])
        n = min(n + 1, _MOST)
    return n, largest


@njit(cache=True, nogil=True)
def _likelihood(f, y, s, cls, n, mixed, above, at):  # pragma: no cover - compiled
    """Log likelihood of the floor f; leaves per pass the densities of `above` the floor and of `at` it."""
    total = 0.0
    ratio = 0.0
    for k in range(n):
        u = (y[k] - f) / s[k]
        place = min(max((u - _LEFT) * _BINS_PER_SIGMA, 0.0), mixed.shape[1] - 2.0)
        i = int(place)
        share = place - i
        d = mixed[cls[k], i] * (1.0 - share) + mixed[cls[k], i + 1] * share
        above[k] = max(d, 1e-200)
        at[k] = math.exp(-0.5 * u * u) * 0.3989422804014327
        total += math.log(above[k])
        ratio += at[k] / above[k]
    return total + math.log(max(ratio, 1e-200))


@njit(cache=True, nogil=True)
def _posterior(
    cells, first, height, sigma, lowest, smallest, parts, share, floor, sigma_own
):  # pragma: no cover - compiled
    """Fills `floor` and `sigma_own` of the cells; returns the expected number of passes in each part of g."""
    y, s, cls = np.empty(_MOST), np.empty(_MOST), np.empty(_MOST, np.int64)
    above, at = np.empty(_MOST), np.empty(_MOST)
    value = np.empty(_STEPS + 1)
    claimed = np.zeros(len(share))
    mixed = np.zeros((parts.shape[0], parts.shape[1]))
    for j in range(len(share)):
        mixed += share[j] * parts[:, :, j]
    for c in cells:
        n, largest = _gather(first[c], first[c + 1], height, sigma, lowest[c], smallest, y, s, cls)
        step = 2.0 * _REACH * largest / _STEPS
        best = -1e300
        for i in range(_STEPS + 1):
            value[i] = _likelihood(-_REACH * largest + i * step, y, s, cls, n, mixed, above, at)
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
            if weight < 1e-2:
                continue
            f = -_REACH * largest + i * step
            _likelihood(f, y, s, cls, n, mixed, above, at)
            ratio = 0.0
            for k in range(n):
                ratio += at[k] / above[k]
            for k in range(n):
                # The chance that pass k is not the one at the floor, shared out over the parts of g.
                other = weight * (1.0 - at[k] / above[k] / max(ratio, 1e-200)) / above[k]
                u = (y[k] - f) / s[k]
                b = int(min(max((u - _LEFT) * _BINS_PER_SIGMA + 0.5, 0.0), parts.shape[1] - 1.0))
                for j in range(len(share)):
                    claimed[j] += other * share[j] * parts[cls[k], b, j]
    return claimed
