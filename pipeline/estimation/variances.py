"""Variances that the log itself tells: motion densities and shares of errors that come back, settled with the states.

Each round adjusts with the variances as they are, asks the residuals and smoothed increments what they should have
been, and goes on from where it is; so a round after the first costs a few iterations and one covariance pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.config.site import EstimationSettings
from pipeline.estimation import densities as motion_densities
from pipeline.estimation import repeated as repeats
from pipeline.estimation.checkpoint import FORGETFUL, Checkpoint
from pipeline.estimation.densities import Densities
from pipeline.estimation.likelihood import log_likelihood
from pipeline.estimation.marginals import marginals_by_part
from pipeline.estimation.optimise import Optimum, optimise
from pipeline.estimation.problem import Problem, huber, lengths
from pipeline.estimation.repeated import Repeated
from pipeline.estimation.residuals import corner_residuals

ROUNDS = 4
ROUND_STEPS = 2
"""Iterations within a round: other variances move the states by a share of a sigma, which one step finds."""
SETTLED = 1.25
"""Ratio of densities from one round to the next below which nothing more is gained: a quarter of a density moves a
smoothed sigma by 4 %."""


@dataclass(frozen=True, eq=False)
class Settled:
    """An optimum with the variances it belongs to."""

    problem: Problem
    optimum: Optimum
    repeated: Repeated
    densities: tuple[Densities, ...]
    rounds: int
    log_likelihood: tuple[float, ...]
    """Before each round; see ``likelihood``."""


def settle(
    problem: Problem,
    optimum: Optimum,
    settings: EstimationSettings,
    repeated: Repeated,
    checkpoint: Checkpoint = FORGETFUL,
    window_s: float = motion_densities.WINDOW_S,
    classes: tuple[int, ...] = tuple(range(len(motion_densities.CLASSES))),
) -> Settled:
    """Learn the variances, starting from an optimum with the configured ones.

    Parked is what stands still for `window_s`; densities of other than the `classes` stay as they are.

    If the adjustment does not converge with what was learned, that optimum comes back as it was.
    """
    densities = start = motion_densities.configured(problem, optimum.values, window_s)
    trial, at, shares, rounds = problem, optimum, repeated, 0
    likely: list[float] = []
    for _ in range(ROUNDS):
        increments = motion_densities.Increments(trial, densities)
        for part, found in marginals_by_part(trial, at.values, at.weights):
            increments.add(part, found)
        likely.append(log_likelihood(trial, at, found.log_det))
        new = increments.learned(classes)
        told = told_by(trial, at, settings.huber) if repeated.resting > 0 else None
        moved = motion_densities.moved_by(densities, new)
        trial = replace(
            trial,
            densities=tuple(d.by_interval() for d in new),
            first=at.values,
        )
        densities = new
        rounds += 1
        if told is not None:
            near = _near(told, shares)
            trial, shares = with_repeated(trial, shares, told), told
        else:
            near = True
        if (moved < SETTLED and near) or rounds == ROUNDS:
            break
        at = optimise(trial, settings.huber, ROUND_STEPS, True, checkpoint, f"round {rounds}")
    at = optimise(trial, settings.huber, settings.max_iterations, True, checkpoint, "settled")
    if not at.converged:
        return Settled(problem, optimum, repeated, tuple(start), 0, ())
    return Settled(trial, at, shares, tuple(densities), rounds, tuple(likely))


def told_by(problem: Problem, optimum: Optimum, k: float) -> Repeated | None:
    """Shares of what comes back, by the residuals of all corners."""
    residuals, use, tracks, rows = [], [], [], []
    without = replace(optimum.values, z=optimum.values.z.copy())
    for group in problem.corners:
        if group.offset is not None:
            without.z[problem.statics.columns[group.offset]] = 0.0
    seen = problem.epochs.observations
    for group, alive in zip(problem.corners, optimum.weights.corners, strict=True):
        r, _ = corner_residuals(group, without, problem.statics, jacobians=False)
        weight, _ = huber(lengths(r, 2), k, alive)
        residuals.append(np.nan_to_num(r))
        use.append(np.repeat(weight == 1, 2, axis=1))
        tracks.append(seen.camera[group.rows] * len(problem.network.tag_id) + seen.tag[group.rows])
        rows.append(group.rows)
    if not rows:
        return None
    stay = repeats.rests(seen)[np.concatenate(rows)]
    return repeats.measured(np.concatenate(residuals), np.concatenate(tracks), stay, np.concatenate(use))


def with_repeated(problem: Problem, old: Repeated, new: Repeated) -> Problem:
    """The same problem with other shares: offsets keep their values, their priors and all information changes."""
    share = repeats.information_share(repeats.rests(problem.epochs.observations), new)
    corners = tuple(replace(g, share=share[g.rows]) for g in problem.corners)
    factor = np.sqrt(new.constant / old.constant)
    scale, z = list(problem.statics.scale), problem.first.z.copy()
    for k, static in enumerate(problem.network.statics):
        if static.source == repeats.SOURCE:
            scale[k] = factor * scale[k]
            z[problem.statics.columns[k]] /= factor
    statics = replace(problem.statics, scale=tuple(scale))
    return replace(problem, corners=corners, statics=statics, first=replace(problem.first, z=z))


def _near(a: Repeated, b: Repeated) -> bool:
    return max(abs(np.log(a.constant / b.constant)), abs(np.log(a.resting / b.resting))) < np.log(SETTLED)
