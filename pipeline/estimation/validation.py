"""What a log says against itself: each benchmark predicted without its survey, and odd frames against even ones."""

from __future__ import annotations

import numpy as np
import scipy.stats

from pipeline.estimation import arrow
from pipeline.estimation.gauss_newton import HOLD
from pipeline.estimation.marginals import Marginals
from pipeline.estimation.normal import linearise
from pipeline.estimation.problem import (
    Problem,
    Weights,
    first_residual,
    huber,
    lengths,
    motion_residual,
    unchecked_statics,
)
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.estimation.values import Values
from pipeline.network import frames as fr

PREDICTED_M = 1.0
"""A benchmark that the rest of the log places no better than this was not predicted."""
OFF_CHANCE = 1e-3
"""A benchmark further off than chance allows in one of a thousand is named."""
DRAWS = 8
"""Logs of pure noise from which the disagreement of the two halves is predicted."""
SEED = 20150615


def left_out(problem: Problem, values: Values, found: Marginals) -> dict[str, dict]:
    """Each benchmark's position as all others and the machine's own measurements predict it, against its survey.

    The estimate ``z`` with covariance ``P`` joins the survey ``N(0, I)`` with everything else; everything else alone
    has the information ``P^-1 - I`` and the estimate ``(P^-1 - I)^-1 P^-1 z``. No adjustment is repeated.

    Returns
    -------
    dict of str to dict
        By benchmark: ``difference_mm`` (predicted minus surveyed, along the world's axes), ``sigma_mm`` (of the
        difference, the survey's own included), ``normalised`` (its length in sigmas), ``chance`` (of one as long) and
        ``off`` (it is below ``OFF_CHANCE``), or ``why`` it cannot be predicted.
    """
    out: dict[str, dict] = {}
    for marker in problem.network.markers:
        columns = problem.statics.columns[marker.mount]
        if not marker.benchmark or fr.marker_frame(marker.name) not in problem.tie.frames:
            continue
        P, scale = found.P_zz[np.ix_(columns, columns)], problem.statics.scale[marker.mount]
        if len(columns) == 0:
            out[marker.name] = {"why": "the file states it without uncertainty"}
            continue
        information = np.linalg.inv(P) - np.eye(len(columns))
        values_, vectors = np.linalg.eigh(0.5 * (information + information.T))
        told = values_ > 1e-9
        rest = (vectors[:, told] / values_[told]) @ vectors[:, told].T
        predicted = rest @ np.linalg.solve(P, values.z[columns])
        R = problem.statics.base[marker.mount][:3, :3]
        cov = R @ (scale @ (rest + np.eye(len(columns))) @ scale.T)[:3, :3] @ R.T
        sigma = np.sqrt(np.diagonal(cov))
        free = scale[:3] @ vectors[:, ~told]
        if sigma.max() > PREDICTED_M or np.abs(free).max(initial=0.0) > 1e-6:
            out[marker.name] = {"why": "nothing else in this log tells its place"}
            continue
        difference = R @ (scale @ predicted)[:3]
        length = float(difference @ np.linalg.lstsq(cov, difference, rcond=1e-12)[0])
        chance = float(scipy.stats.chi2.sf(length, 3))
        out[marker.name] = {
            "difference_mm": [round(1000 * float(v), 2) for v in difference],
            "sigma_mm": [round(1000 * float(v), 2) for v in sigma],
            "normalised": round(float(np.sqrt(length)), 2),
            "chance": float(f"{chance:.2g}"),
            "off": bool(chance < OFF_CHANCE),
        }
    return out


def odd_even(problem: Problem, values: Values, weights: Weights, seen) -> dict:
    """Adjust the odd and the even frames of every camera apart, and compare the middle of the cutting edge.

    Both halves keep the statics' priors and the motion. From the common optimum each is one Newton step away. What
    disagreement to expect comes from logs of pure noise through the same two factorisations: the halves share
    priors, so its covariance has no short form. It is the random part that is tested; what repeats in every frame, and
    the survey, are the same in both.

    Parameters
    ----------
    problem, values, weights : Problem, Values, Weights
        At the optimum.
    seen : (E,) bool array
        Epochs at which the cutting edge was observed: only these count.

    Returns
    -------
    dict
        ``observed_mm`` and ``predicted_mm``, root mean square difference in elevation; ``ratio`` and ``ratio_95``, what
        it is in 95 % of logs of pure noise.
    """
    if not np.any(seen):
        return {}
    rng = np.random.default_rng(SEED)
    prior = _prior_noise(problem, values, rng)
    pairs = []
    for half in (0, 1):
        own = _half(problem, weights, half)
        chains, C, g_z = linearise(problem, values, own)
        held = unchecked_statics(problem)
        C[held, held] += HOLD
        step = arrow.solve(chains, C, g_z)
        x, z = _measurement_noise(problem, values, own, chains, rng)
        rhs_x = [a + b for a, b in zip(x, prior[0], strict=True)]
        rhs_z = z + prior[1]
        rhs_z[held] = 0.0
        drawn = arrow.solve_again(step, chains, rhs_x, rhs_z)
        moved = [(step.dx, step.dz)]
        moved += [(tuple(dx[..., d] for dx in drawn[0]), drawn[1][:, d]) for d in range(DRAWS)]
        pairs.append([_elevation(problem, values, dx, dz)[seen] for dx, dz in moved])
    apart = [float(np.sqrt(np.mean((a - b) ** 2))) for a, b in zip(*pairs, strict=True)]
    observed, drawn_rms = apart[0], np.array(apart[1:])
    predicted = float(np.sqrt(np.mean(drawn_rms**2)))
    if predicted == 0:
        return {}
    # Few draws: their spread is taken as that of a chi-square with as many degrees of freedom as fit it.
    spread = max(float(np.std(drawn_rms**2, ddof=1)) / predicted**2, 1e-3)
    dof = 2 / spread**2
    # The draws know their own mean only to spread / sqrt(DRAWS).
    low, high = scipy.stats.f.ppf([0.025, 0.975], dof, DRAWS * dof)
    return {
        "epochs": int(np.sum(seen)),
        "observed_mm": round(1000 * observed, 3),
        "predicted_mm": round(1000 * predicted, 3),
        "ratio": round(observed / predicted, 3),
        "ratio_95": [round(float(np.sqrt(low)), 3), round(float(np.sqrt(high)), 3)],
    }


def _half(problem: Problem, weights: Weights, half: int) -> Weights:
    """Weights with only every second frame of each camera, and every second reading of each sensor."""
    frames: dict[int, list[np.ndarray]] = {}
    for group in problem.corners:
        frames.setdefault(group.camera, []).append(group.epoch)
    parity = {c: np.unique(np.concatenate(e)) for c, e in frames.items()}
    corners = [
        alive & (np.searchsorted(parity[g.camera], g.epoch) % 2 == half)[:, None]
        for g, alive in zip(problem.corners, weights.corners, strict=True)
    ]
    sensors = [alive & (np.arange(len(alive)) % 2 == half)[:, None] for alive in weights.sensors]
    return Weights(weights.huber, tuple(corners), tuple(sensors))


def _prior_noise(problem: Problem, values: Values, rng):
    """``J' e`` of unit noise on motion and priors: per chain (E, b, DRAWS), and (p, DRAWS)."""
    E = len(problem.epochs.time_ns)
    x = [np.zeros((E, problem.chain_size(c), DRAWS)) for c in range(len(problem.chains))]
    for k in range(len(problem.tie.variables)):
        c, at = problem.place(k)
        _, J_1, J_2 = motion_residual(problem, values, k)
        e = rng.standard_normal((E - 1, J_1.shape[1], DRAWS))
        x[c][:-1, at] += np.swapaxes(J_1, -1, -2) @ e
        x[c][1:, at] += np.swapaxes(J_2, -1, -2) @ e
        _, J = first_residual(problem, values, k)
        x[c][0, at] += J.T @ rng.standard_normal((len(J), DRAWS))
    return x, rng.standard_normal((problem.statics.size, DRAWS))


def _measurement_noise(problem: Problem, values: Values, weights: Weights, chains, rng):
    """The same of unit noise on corners and readings, each with the root of its weight."""
    x = [np.zeros((*chain.g.shape, DRAWS)) for chain in chains]
    z = np.zeros((problem.statics.size, DRAWS))

    def add(epoch, r, J, size, alive, share):
        weight = share * np.repeat(huber(lengths(r, size), weights.huber, alive)[0], size, axis=1)
        e = np.sqrt(weight)[..., None] * rng.standard_normal((*r.shape, DRAWS))
        for v, J_v in J.variables.items():
            c, at = problem.place(v)
            np.add.at(x[c][:, at], epoch, np.swapaxes(np.where(weight[..., None] > 0, J_v, 0), -1, -2) @ e)
        for s, J_s in J.statics.items():
            z[problem.statics.columns[s]] += np.einsum(
                "nmi,nmd->id", np.where(weight[..., None] > 0, J_s, 0), e, optimize=True
            )

    for group, alive in zip(problem.corners, weights.corners, strict=True):
        r, J = corner_residuals(group, values, problem.statics)
        add(group.epoch, r, J, 2, alive, group.share[:, None])
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, J = sensor_residuals(readings, values, problem.statics)
        add(readings.epoch, r, J, 1, alive, 1.0)
    return x, z


def _elevation(problem: Problem, values: Values, dx, dz):
    """(E,) elevation of the middle of the cutting edge, of values moved by a step."""
    places = map(problem.place, range(len(problem.tie.variables)))
    moved = values.retract([dx[c][:, at] for c, at in places], dz)
    path = problem.tie.frames.path(fr.WORLD, fr.TOOL)
    _, T = fr.along(path, lambda edge: moved.edge_pose(problem.statics, edge))
    return np.broadcast_to(T, (len(problem.epochs.time_ns), 4, 4))[:, 2, 3]
