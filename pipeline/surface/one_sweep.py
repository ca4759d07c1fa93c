"""How errors of cells add up: those of one sweep of the edge err alike."""

from __future__ import annotations

import numpy as np

ONE_SWEEP_S = 0.5
"""Cells whose passes follow each other within this are one sweep and share one own error, wholly. True correlation
decays within a sweep; not knowing how fast, the larger sigma is taken."""


def sweeps_of(sigma: np.ndarray, time_ns: np.ndarray, gap_s: float = ONE_SWEEP_S) -> np.ndarray:
    """Sums of the sigmas of each sweep's cells, (sweeps,): wholly correlated within one, independent between them.

    Parameters
    ----------
    sigma : (n,) array
        Own standard deviations.
    time_ns : (n,) int array
        When each cell's pass was.
    gap_s : float
        A longer pause begins another sweep.
    """
    if not len(sigma):
        return np.zeros(0)
    order = np.argsort(time_ns, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(time_ns[order]) > gap_s * 1e9))
    return np.add.reduceat(sigma[order], starts)


def sigma_of_sum(
    sigma: np.ndarray, sigma_pass: np.ndarray, time_ns: np.ndarray, gap_s: float = ONE_SWEEP_S
) -> float:
    """Own standard deviation of a sum over cells.

    A cell that several passes tell is known better than one pass is, but its neighbours are told by the same passes,
    whichever of them is the lowest there. So sweeps count with the sigma of one pass, and the sum is no less certain
    than cells that all err alike. With the sigmas of the cells, sweeps as independent, the means of stations were 1.4
    of their own sigma off in 40 drawn trenches.

    Parameters
    ----------
    sigma : (n,) array
        Own standard deviation of each cell.
    sigma_pass : (n,) array
        Own standard deviation of the pass that is its lowest.
    time_ns : (n,) int array
        When that pass was.
    gap_s : float
        A longer pause begins another sweep.
    """
    alike = float(np.sum(sigma))
    return min(alike, float(np.sqrt(np.sum(sweeps_of(sigma_pass, time_ns, gap_s) ** 2))))
