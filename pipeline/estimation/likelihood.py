"""How likely the log is under its variances, whatever the states and statics were: Laplace's marginal likelihood.

Densities of motion and the like are chosen so that this is largest; it stands in solution.json for every round, so that
one can see it rise. With ``r`` all whitened residuals, ``W`` what whitens them and ``H`` the normal matrix,

    log p(y) = -sum r² / 2 + log |W_y| - m/2 log 2π + log |d r_prior / d(x, z)| - log |H| / 2

``m`` measured components; the priors (motion, first epoch, statics) are as many rows as there are unknowns. It costs
a sum over what the factorisation leaves anyway. Under Huber's loss the sum is that of the loss: what its density would
be divided by is the same for all variances. A picture counts with the information share of its stay, as if its sigma
were so much larger.
"""

from __future__ import annotations

import numpy as np

from pipeline.estimation import motion
from pipeline.estimation.optimise import Optimum
from pipeline.estimation.problem import Problem, first_residual


def log_likelihood(problem: Problem, optimum: Optimum, log_det: float) -> float:
    """Logarithm of the marginal likelihood at an optimum, natural; pixels, and the units of the readings.

    Parameters
    ----------
    problem, optimum
        The whole log, and where its iterations ended.
    log_det : float
        Of the normal matrix there; ``Marginals.log_det``.
    """
    measured, log_whitener = 0, 0.0
    for group, alive in zip(problem.corners, optimum.weights.corners, strict=True):
        diagonal = np.einsum("nkii->nki", group.whitener)
        corner = np.log(diagonal).sum(axis=-1) + np.log(group.share)[:, None]  # two halves of log share
        log_whitener += float(np.sum(corner[alive]))
        measured += 2 * int(alive.sum())
    for readings, alive in zip(problem.sensors, optimum.weights.sensors, strict=True):
        log_whitener -= float(np.sum(np.log(readings.sigma)[alive[:, 0]]))
        measured += int(alive.sum())
    return float(
        -optimum.cost
        + log_whitener
        - 0.5 * measured * np.log(2 * np.pi)
        + log_volume(problem, optimum.values)
        - 0.5 * log_det
    )


def log_volume(problem: Problem, values) -> float:
    """``log |d r_prior / d(x, z)|``: of the motion from epoch to epoch, and of the first epoch's weak prior.

    An increment is triangular: by its own state alone it has the determinant ``|W| |Jr^-1|²``, and
    ``|Jr^-1|`` of a pose is the square of that of its turn, ``θ² / (2 - 2 cos θ)``. Statics are whitened: 0.
    """
    total = 0.0
    for k, variable in enumerate(problem.tie.variables):
        W = motion.whitening(problem.dt_s, problem.densities[k])
        total += float(np.sum(np.log(W[..., 0]) + np.log(W[..., 2])))
        if variable.kind == "moving":
            R = values.pose[k][:, :3, :3]
            cosine = 0.5 * (np.einsum("nij,nij->n", R[:-1], R[1:]) - 1)
            # 2 - 2 cos of a small angle, from the difference of the matrices: no digits are lost.
            chord = 0.5 * np.einsum("nij,nij->n", R[1:] - R[:-1], R[1:] - R[:-1])
            angle = np.arctan2(np.sqrt(np.maximum(chord * (1 - chord / 4), 0.0)), cosine)
            turned = chord > 1e-16
            total += 4.0 * float(np.sum(np.log(angle[turned] ** 2 / chord[turned])))
        if problem.opens:
            total += float(np.linalg.slogdet(first_residual(problem, values, k)[1])[1])
    return total
