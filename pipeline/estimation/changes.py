"""Change test in time: did a benchmark, a camera, a marker or a sensor move during the log, when, and how far?

A change is a step of one static (``steps.py``). Corner errors are not white: what ``repeated.py`` calls resting comes
back from frame to frame, and dirt on a print drifts with the light. So the scores of stretches of the log are held
against what white noise would give, in batches of 1, 2, 4 ... stretches and after the step itself is taken out. ``T``
is divided, and the sigmas' squares are multiplied, by what is found, never by less than one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from pipeline.estimation.problem import Problem, Weights, lengths
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.estimation.steps import Sums, step_of, sums
from pipeline.estimation.values import Values

STRETCHES = 240
"""At most so many candidate instants before one is found: two minutes of an 8 h shift."""
STRETCH_S = 1.0
"""No stretch is shorter: within it the errors of neighbouring frames are alike."""
FEWEST = 16
"""Stretches below which the scatter of the scores cannot be told, and so no change."""
BATCHES = 8
"""The fewest batches of stretches that tell how large their scatter is."""
FALSE_ALARM = 1e-4
"""Chance of naming a change in one static that has none, if the scatter is what was found: of thirty statics one in 300
shifts. The bar is one in ten; the rest is for what the batches do not see."""
WIDE = 40.0
"""Whitened length beyond which a corner is a blunder here. The adjustment leaves out what is beyond 7.5, which is a
benchmark that moved by 15 mm: gated like that, it would be silently lost instead of found."""
INSTANT = 7.35
"""How far T falls at the ends of the instant's 95 % interval: ``1 - (1 - exp(-x / 2))² = 0.05``, of a random walk that
drifts away from its peak on both sides."""
ALIKE = 0.01
"""Statics whose T is within this share of the largest explain the log as well. Of two cameras on one body that see the
same benchmarks only their turn against each other is known: 95,715.7 and 95,715.3."""
SMALL_M, SMALL_RAD = 0.001, math.radians(0.01)
"""Steps below both are not named: no print and no lens is known better, and nothing is done about them."""


@dataclass(frozen=True, eq=False)
class Change:
    """A step of one static."""

    static: int
    epoch: int
    first: int
    """Epochs between which it happened, with 95 %."""
    last: int
    step: np.ndarray
    """(r,) in the static's whitened unknowns."""
    cov: np.ndarray
    """(r, r)."""
    statistic: float
    """T over the inflation."""
    log_p: float
    """Natural logarithm of the chance of such a T somewhere in the log without a change."""
    inflation: float
    """How much larger than white the scatter of the scores is."""


def instants(problem: Problem, count: int = STRETCHES) -> np.ndarray:
    """Candidate epochs, evenly over those of the log; the first is 0."""
    t = problem.epochs.time_s
    count = int(max(1, min(count, t[-1] / STRETCH_S, len(t))))
    return np.unique(np.linspace(0, len(t), count, endpoint=False).astype(np.int64))


def wide_weights(problem: Problem, values: Values, k: float) -> Weights:
    """Huber's weights with only blunders left out."""
    corners, sensors = [], []
    with np.errstate(invalid="ignore"):
        for group in problem.corners:
            r, _ = corner_residuals(group, values, problem.statics, jacobians=False)
            corners.append(lengths(r, 2) <= WIDE)
        for readings in problem.sensors:
            r, _ = sensor_residuals(readings, values, problem.statics, jacobians=False)
            sensors.append(lengths(r, 1) <= WIDE)
    return Weights(k, tuple(corners), tuple(sensors))


def inflation(found: Sums, columns, j: int, step) -> tuple[float, float]:
    """Long-run variance of the scores over that of white noise, with a step from candidate j on taken out; at least 1.

    Batches of 1, 2, 4 ... stretches, down to BATCHES of them; of each the mean over the directions, and the largest
    direction over what so many white batches would show (Marchenko and Pastur's edge). What a batch of one length
    misses of correlation falls as one over the length, so ``2 f(2 m) - f(m)`` misses none of it; the largest counts.
    With errors that drift over ten seconds, of a log of three minutes, the batches alone told 2.4 to 3.3 where ten was
    right, and two logs of three had a false alarm; now none of 16.

    Returns
    -------
    f : float
    dof : float
        How many batches tell it.
    """
    K, r = len(found.at), len(columns)
    ix = np.ix_(np.arange(K), columns, columns)
    own, cross, g = found.own[ix], found.cross[:, columns], found.g[:, columns]
    V = own - np.concatenate([own[1:], np.zeros_like(own[:1])])
    N = cross - np.concatenate([cross[1:], np.zeros_like(cross[:1])])
    d = g - np.concatenate([g[1:], np.zeros_like(g[:1])])
    after = (np.arange(K) >= j)[:, None]
    d = d + after * (V @ step) - N @ (found.P_zz @ (cross[j].T @ step))
    worst, dof, size, last = 1.0, float(K), 1, None
    while K // size >= BATCHES:
        n = K // size
        V_n = V[: n * size].reshape(n, size, r, r).sum(axis=1)
        d_n = d[: n * size].reshape(n, size, r).sum(axis=1)
        values, vectors = np.linalg.eigh(0.5 * (V_n + np.swapaxes(V_n, -1, -2)))
        scale = np.where(values > 1e-6, 1 / np.sqrt(np.maximum(values, 1e-6)), 0.0)
        white = np.einsum("nij,nj,nkj,nk->ni", vectors, scale, vectors, d_n, optimize=True)
        live = int(n - np.sum(scale.max(axis=1) == 0))
        if live < BATCHES:
            break
        spread = white.T @ white / (live - 2)
        # One stretch that a blunder or a gap spoils must not hide a change: it counts at most four times the median.
        length = np.sum(white**2, axis=1)
        limit = 4 * max(float(np.median(length[length > 0])), r)
        kept = np.minimum(1.0, limit / np.maximum(length, limit))
        robust = (white * kept[:, None]).T @ white / (live - 2)
        spread = spread if np.trace(spread) < 2 * np.trace(robust) else robust
        edge = (1 + math.sqrt(r / live)) ** 2
        told = np.array([float(np.trace(spread)) / r, float(np.linalg.eigvalsh(spread)[-1]) / edge])
        best = float(max(told.max(), 0.0 if last is None else (2 * told - last).max()))
        if best > worst:
            worst, dof = best, float(live)
        last, size = told, 2 * size
    return worst, dof


def like_chi_square(T: float, r: int, dof: float) -> float:
    """``T`` over an inflation that ``dof`` batches tell, as the chi-square of r that is as rare: F's longer tail."""
    rare = scipy.stats.f.logsf(T / r, r, dof)
    return T if rare < -600 else float(min(T, scipy.stats.chi2.isf(math.exp(rare), r)))


def log_chance(T: float, r: int, K: int) -> float:
    """Logarithm of the chance that the largest of T over K instants of a log without a change is as large.

    James, James and Siegmund's approximation to the maximum of the squared Brownian bridge over its variance in r
    dimensions, between the first and the last instant.
    """
    if r + 2 >= T:
        return 0.0
    span = 2 * math.log(max(K - 1, 2))
    density = (0.5 * r) * math.log(0.5 * T) - 0.5 * T - math.lgamma(0.5 * r)
    return min(0.0, density + math.log((1 - r / T) * span + 2 / T))


@dataclass(frozen=True, eq=False)
class Peak:
    """The best step of one static, whether or not chance explains it."""

    T: np.ndarray
    """(K,) by candidate instant, under white noise."""
    at: int
    """The candidate at which it is largest."""
    step: np.ndarray
    cov: np.ndarray
    """Of the step, under white noise."""
    inflation: float
    log_p: float
    """See ``Change``."""


def peak(found: Sums, static: int) -> Peak:
    """The step of a static that explains most, and how likely it is without a change."""
    columns, K = found.rows[static], len(found.at)
    T = np.array([0.0] + [step_of(found, columns, j)[2] for j in range(1, K)])
    j = int(np.argmax(T))
    step, cov, _ = step_of(found, columns, j)
    f, dof = inflation(found, columns, j, step)
    log_p = log_chance(like_chi_square(T[j] / f, len(columns), dof), len(columns), K)
    return Peak(T, j, step, cov, f, log_p)


def strongest(problem: Problem, found: Sums) -> tuple[Change | None, tuple[int, ...]]:
    """The change that explains most, if no chance does, and the statics that explain it as well or nearly."""
    K = len(found.at)
    if K < FEWEST:
        return None, ()
    peaks = {s: peak(found, s) for s in found.rows}
    named = [
        s
        for s, one in peaks.items()
        if one.log_p < math.log(FALSE_ALARM) and not is_small(problem, s, one.step)
    ]
    if not named:
        return None, ()
    # Which of them it was, T itself tells: they are rival explanations of the same residuals, and the inflation of each
    # is known to a factor of two at best.
    s = max(named, key=lambda s: peaks[s].T.max())
    best = peaks[s]
    top, f = float(best.T[best.at]), best.inflation
    # T falls by INSTANT f where the instant leaves its 95 % interval.
    near = np.flatnonzero(top - best.T < INSTANT * f)
    first, last = int(found.at[max(near[0] - 1, 0)]), int(found.at[min(near[-1] + 1, K - 1)])
    change = Change(s, int(found.at[best.at]), first, last, best.step, f * best.cov, top / f, best.log_p, f)
    rivals = (r for r, one in peaks.items() if r != s and one.T[best.at] > top * (1 - ALIKE))
    return change, tuple(rivals)


def is_small(problem: Problem, s: int, step) -> bool:
    """Whether a step of a pose is below what is worth a sentence."""
    if not problem.statics.is_pose[s]:
        return False
    xi = problem.statics.scale[s] @ step
    return bool(np.linalg.norm(xi[:3]) < SMALL_M and np.linalg.norm(xi[3:]) < SMALL_RAD)


def find(problem: Problem, values: Values, k: float) -> tuple[Change | None, tuple[int, ...]]:
    """The strongest change of the log, its instant looked for twice: over all of it, then near the first answer.

    Returns
    -------
    change : Change or None
    others : tuple of int
        Statics whose change would explain the log as well.
    """
    at = instants(problem)
    if len(at) < FEWEST:
        return None, ()
    weights = wide_weights(problem, values, k)
    change, others = strongest(problem, sums(problem, values, weights, at))
    if change is None:
        return None, ()
    a, b = max(change.first, 1), min(change.last, len(problem.epochs.time_ns) - 1)
    fine = np.unique(np.r_[0, np.linspace(a, b, min(STRETCHES, b - a + 1)).astype(np.int64)])
    near = sums(problem, values, weights, fine)
    columns = near.rows[change.static]
    T = np.array([0.0] + [step_of(near, columns, j)[2] for j in range(1, len(fine))])
    j = int(np.argmax(T))
    step, cov, _ = step_of(near, columns, j)
    inside = np.flatnonzero(T[j] - T < INSTANT * change.inflation)
    better = replace(
        change,
        epoch=int(fine[j]),
        first=int(fine[max(inside[0] - 1, 1)]),
        last=int(fine[inside[-1]]),
        step=step,
        cov=change.inflation * cov,
        statistic=float(T[j] / change.inflation),
    )
    return better, others
