"""Eq. (2) of the paper, solved: Gauss-Newton with robust weights, damped only where a stretch of the log needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import EstimationError
from pipeline.estimation import arrow
from pipeline.estimation.problem import (
    Problem,
    Weights,
    cost_by_epoch,
    keep_all,
    lengths,
    linearise,
    unchecked_statics,
)
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.estimation.values import Values

STRETCH = 64
"""Epochs that are damped together: some ten seconds of frames. Inside a gap that holds a whole swing the model is not
linear over a step; a global damping would let that one gap throttle the whole shift."""
DAMPING_FIRST, DAMPING_UP, DAMPING_DOWN, DAMPING_NONE = 1e-6, 30.0, 0.03, 1e-8
"""Shares of the diagonal. Nearly all of it is motion prior, which neighbouring epochs cancel: what holds a gap as a
whole is a millionth of it."""
STEP_SIGMAS = 0.05
"""Converged when no unknown moves by more of its posterior sigma. ``-g' dx`` is the squared length of the whole step
in that measure, so it bounds every single one."""
IRLS_STEPS = 2
"""First steps with re-weighting only: far from the optimum most corners are beyond the threshold, and without
their curvature along the residual nothing would hold the step."""
GATE = 3.0
"""After Huber has converged, what is further off than this many times its threshold is no measurement: its weight
becomes zero, and the rest is adjusted again. Gated from the start, a bad start would throw away good corners."""
GATE_ROUNDS = 4
TRIES = 14
HOLD = 1e12
"""Information that keeps an unchecked static where it is during the steps; a prior is 1. Not for covariances."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where the iterations ended."""

    values: Values
    weights: Weights
    iterations: int
    converged: bool
    last_step_sigmas: float
    cost: float


def optimise(problem: Problem, huber: float, max_iterations: int) -> Optimum:
    """The states and statics that fit everything best.

    Raises
    ------
    EstimationError
        The start cannot be evaluated.
    """
    values, weights = problem.first, keep_all(problem, huber)
    iterations, converged, sigmas, cost = 0, False, np.inf, np.inf
    for round_ in range(GATE_ROUNDS):
        limit = max_iterations - iterations
        values, used, converged, sigmas, cost = _iterate(problem, values, weights, limit)
        iterations += used
        gated = gate(problem, values, weights)
        same = all(np.array_equal(a, b) for a, b in zip(gated.corners, weights.corners, strict=True)) and all(
            np.array_equal(a, b) for a, b in zip(gated.sensors, weights.sensors, strict=True)
        )
        if same or not converged or iterations >= max_iterations or round_ == GATE_ROUNDS - 1:
            break
        weights, converged = gated, False
    return Optimum(values, weights, iterations, converged, sigmas, cost)


def gate(problem: Problem, values: Values, weights: Weights) -> Weights:
    """Weights that leave out what is a gross outlier at these values."""
    limit = GATE * weights.huber
    corners = []
    for group in problem.corners:
        with np.errstate(invalid="ignore"):
            corners.append(
                lengths(corner_residuals(group, values, problem.statics, jacobians=False)[0], 2) <= limit
            )
    sensors = []
    for readings in problem.sensors:
        with np.errstate(invalid="ignore"):
            sensors.append(
                lengths(sensor_residuals(readings, values, problem.statics, jacobians=False)[0], 1) <= limit
            )
    return replace(weights, corners=tuple(corners), sensors=tuple(sensors))


def deltas_of(problem: Problem, dx) -> list[np.ndarray]:
    """Chain steps, cut up by variable."""
    out = []
    for k in range(len(problem.tie.variables)):
        c, at = problem.place(k)
        out.append(dx[c][:, at])
    return out


def _iterate(problem: Problem, values: Values, weights: Weights, limit: int):
    E = len(problem.epochs.time_ns)
    stretch = np.arange(E) // STRETCH
    damping = np.zeros(stretch[-1] + 1)
    local, prior = cost_by_epoch(problem, values, weights)
    if not np.isfinite(local.sum()):
        raise EstimationError(
            "the starting values of the adjustment cannot be evaluated; look at the detections of the first "
            "epochs and at the mounts in machine.toml"
        )
    held = unchecked_statics(problem)
    sigmas, converged, used = np.inf, False, 0
    while used < limit and not converged:
        used += 1
        chains, C, g_z = linearise(problem, values, weights, newton=used > IRLS_STEPS)
        C[held, held] += HOLD
        shorten = 1.0
        for attempt in range(TRIES):
            step = _solve(chains, C, g_z, damping[stretch])
            decrease = -sum(float(np.sum(c.g * d)) for c, d in zip(chains, step.dx, strict=True)) - float(
                g_z @ step.dz
            )
            trial = values.retract(deltas_of(problem, [shorten * d for d in step.dx]), shorten * step.dz)
            trial_local, trial_prior = cost_by_epoch(problem, trial, weights)
            change = trial_local.sum() + trial_prior - local.sum() - prior
            rise = np.bincount(stretch, trial_local - local)
            # Rounding of the sum, and what re-weighting may cost, are no reason to damp.
            if change <= 1e-10 * (local.sum() + prior) + 1e-9:
                break
            risen = rise > max(0.02 * rise.max(), 1e-3)  # the stretches that spoil the step
            damping[risen] = np.maximum(damping[risen] * DAMPING_UP, DAMPING_FIRST)
            if attempt >= 3:
                shorten *= 0.5
        else:
            # No step helps any more: at the bottom to rounding, or stuck, which the sigmas tell.
            sigmas = np.sqrt(max(decrease, 0.0))
            return values, used, sigmas < STEP_SIGMAS, sigmas, local.sum() + prior
        values = trial
        before = np.bincount(stretch, local)
        worse = rise > 0.1 * before + 10.0
        local, prior = trial_local, trial_prior
        sigmas = np.sqrt(max(decrease, 0.0))
        converged = bool(sigmas < STEP_SIGMAS and shorten == 1.0 and np.all(damping < 1e-5))
        damping *= DAMPING_DOWN
        damping[damping < DAMPING_NONE] = 0.0
        damping[worse] = np.maximum(damping[worse], DAMPING_FIRST)
    return values, used, converged, sigmas, local.sum() + prior


def _solve(chains, C, g_z, damping):
    """The step; where rounding leaves the matrix indefinite, everything is damped a little."""
    for extra in (0.0, 1e-9, 1e-6, 1e-3):
        try:
            return arrow.solve(chains, C, g_z, damping + extra)
        except np.linalg.LinAlgError:
            continue
    raise EstimationError(
        "the normal equations of this log cannot be solved: measurements contradict each other beyond what the "
        "stated sigmas allow, or a sigma in machine.toml or site.toml is wrong by orders of magnitude"
    )
