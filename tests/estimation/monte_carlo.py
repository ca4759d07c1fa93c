"""Consistency by Monte Carlo: are the covariances as large as the errors of adjustments of drawn networks?"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from pipeline.estimation import adjust
from pipeline.estimation.repeated import WHITE, Repeated
from pipeline.geometry import se3, so3
from tests.estimation.simulator import MACHINE, SITE, Options, draw


@dataclass(frozen=True)
class Sample:
    """Of many drawn networks, at one epoch each."""

    edge: np.ndarray
    """(runs, 3) whitened error of the middle of the cutting edge at a random epoch: N(0, I) if consistent."""
    elevation: np.ndarray
    """(runs,) z-score of its elevation."""
    pose: np.ndarray
    """(runs, 6) whitened error of the tool's pose."""
    statics: np.ndarray
    """(runs, p) z-scores of the statics' components."""
    lenses: np.ndarray
    """(runs, q) those of intrinsics alone."""
    axes: np.ndarray
    """(runs, 3) z-scores of the middle of the cutting edge along the axes of the grid."""


def sample(
    runs: int,
    options: Options,
    trust_files: bool = False,
    seed: int = 1000,
    repeated: Repeated = WHITE,
    learn: bool = False,
) -> Sample:
    """Draw networks and adjust them.

    Parameters
    ----------
    runs : int
        How many.
    options : Options
        Of the simulation.
    trust_files : bool
        Adjust as if the files were exact, though the statics are drawn: the border of the normal matrix switched off.
    seed : int
        Of the first run.
    repeated, learn
        Of ``adjust``.
    """
    edge, elevation, pose, statics, lenses, axes = [], [], [], [], [], []
    for run in range(runs):
        drawn = draw(seed + run, options)
        network = drawn.network
        if trust_files:
            network = replace(
                network,
                statics=tuple(replace(s, covariance=np.zeros_like(s.covariance)) for s in network.statics),
            )
        solution = adjust(network, drawn.observations, drawn.readings, None, repeated, learn)
        tool = solution.body("tool")
        error, rows = drawn.error(tool)
        k = np.random.default_rng(run).integers(len(rows))
        xi, T = error[k], tool.T_world_body[rows[k]]
        P = (tool.own + tool.common)[rows[k]]
        R, C = T[:3, :3], P[:3, :3]
        edge.append(_whitened(xi[:3], C))
        elevation.append((R @ xi[:3])[2] / np.sqrt((R @ C @ R.T)[2, 2]))
        axes.append((R @ xi[:3]) / np.sqrt(np.diagonal(R @ C @ R.T)))
        pose.append(_whitened(xi, P))
        z, of_lenses = [], []
        for result, static, truth in zip(solution.statics, network.statics, drawn.statics, strict=True):
            at = len(z)
            free = result.prior_sigma > 0
            if static.is_pose:
                phi = result.file_value[3:]
                chart = np.zeros((6, 6))
                chart[:3, :3], chart[3:, 3:] = static.value[:3, :3], so3.Jr_inv(phi)
                value = result.file_value + chart @ se3.local(static.value, truth)
            else:
                value = truth
            z += list(((value - result.value) / np.where(free, result.sigma, 1.0))[free])
            if static.source == "intrinsics":
                of_lenses += z[at:]
        statics.append(z)
        lenses.append(of_lenses)
    return Sample(
        np.array(edge),
        np.array(elevation),
        np.array(pose),
        np.array(statics),
        np.array(lenses),
        np.array(axes),
    )


def cover(z, factor: float = 1.96) -> float:
    """Share of z-scores inside their 95 % interval."""
    return float(np.mean(np.abs(z) < factor))


def band(runs: int, dof: int) -> tuple[float, float]:
    """95 % band of the mean normalised estimation error squared of ``runs`` runs."""
    low, high = scipy.stats.chi2.ppf([0.025, 0.975], runs * dof) / runs
    return float(low), float(high)


def nees(whitened) -> float:
    """Mean squared length of whitened errors."""
    return float(np.mean(np.sum(np.asarray(whitened).reshape(len(whitened), -1) ** 2, axis=1)))


def small(bucket_marker: bool = False, frames: int = 25) -> Options:
    """The network of the tests: five seconds."""
    return Options(
        epochs=frames,
        bucket_marker=bucket_marker,
        potentiometer=not bucket_marker,
        machine=copy.deepcopy(MACHINE),
        site=copy.deepcopy(SITE),
    )


def _whitened(error, covariance):
    return np.linalg.solve(np.linalg.cholesky(covariance), error)
