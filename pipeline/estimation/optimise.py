"""Eq. (2) of the paper, solved: Gauss-Newton with robust weights, damped only where a stretch of the log needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline import threads
from pipeline.errors import EstimationError
from pipeline.estimation import approach, gates, pull
from pipeline.estimation.checkpoint import (
    FORGETFUL,
    UNKEPT,
    Arrays,
    Checkpoint,
    Iterations,
    arrays_of,
    arrays_of_weights,
    values_of,
    weights_of,
)
from pipeline.estimation.gauss_newton import STEP_SIGMAS, Step, left_after
from pipeline.estimation.linearised import cost_of, parts
from pipeline.estimation.parts import PART_EPOCHS, bounds, joined, part_of
from pipeline.estimation.parts import cut as cut_of
from pipeline.estimation.problem import Problem, Weights, keep_all, unchecked_statics
from pipeline.estimation.values import Values

STRETCH = 64
"""Epochs that are damped together: some ten seconds of frames. Inside a gap that holds a whole swing the model is not
linear over a step; a global damping would let that one gap throttle the whole shift."""
DAMPING_FIRST, DAMPING_UP, DAMPING_DOWN, DAMPING_NONE, DAMPING_MOST = 1e-6, 30.0, 0.03, 1e-8, 1e3
"""Shares of the diagonal. Nearly all of it is motion prior, which neighbouring epochs cancel: what holds a gap as a
whole is a millionth of it. More than the most holds no better and takes as many steps to go as it took to come: from
statics 10,000 sigmas off it had reached 1e88, and the optimum, found in 12 steps, was never told as such."""
NEAR_STEPS = 3
"""Steps of the states with the statics of a sample: 1e5, 500 and 10 sigmas, and 5 are left to the statics."""
SPAN, MARGIN = 3 * PART_EPOCHS, 128
"""Epochs that follow the statics together, and those on either side that are adjusted with them and not kept."""
IRLS_STEPS = 2
"""First steps with re-weighting only: far from the optimum most corners are beyond the threshold, and without
their curvature along the residual nothing would hold the step."""
GATE_ROUNDS = 4
"""Huber's optimum, the same without what is gross or doubtful, with what was doubted for nothing, and one to spare."""
PATIENCE = 0.05
"""A whole step may raise the cost by this share of it, if the statics' next step is less than half as long; else it is
taken back. A step of the statics bends the pictures of all epochs by a hundredth of a pixel. Over 100,000 epochs that
sums up to a rise, which the next step mends; damping the states against it took 20 steps where this takes 2. The length
of the whole next step, 41 sigmas after 37 at 288,000 epochs, is mostly that mending. Where only some stretches rise, it
is they that need damping: with patience a log of four minutes that saw nothing for one took 37 steps instead of 12."""
SPREAD, SPREAD_OVER = 0.5, 100
"""Share of the stretches, and how many at least, from which a rise is the statics' doing: then the step is shortened,
and nothing damped."""
TRIES = 14


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where the iterations ended."""

    values: Values
    weights: Weights
    iterations: int
    converged: bool
    last_step_sigmas: float
    cost: float
    eased: bool = False
    """Whether the statics are those that the measurements tell without the motion prior; see ``pull``."""
    remark: str = ""
    """For the reader of the report, where they should be and are not."""


def optimise(
    problem: Problem,
    huber: float,
    max_iterations: int,
    near=False,
    checkpoint: Checkpoint = FORGETFUL,
    name: str = "",
) -> Optimum:
    """The states and statics that fit everything best.

    Parameters
    ----------
    problem : Problem
        With its start.
    huber : float
        Whitened length beyond which the loss grows linearly.
    max_iterations : int
        Steps of all unknowns together.
    near : bool
        The start is the optimum of other variances: no sample is asked first. Where densities fell thirtyfold, Newton's
        steps alone were 145 sigmas off after two, and 35 followed; after two of re-weighting it is 3, and 10 follow.
        The states of a long log follow the statics first instead.
    checkpoint, name
        Where finished iterations are kept, and under which name.

    Raises
    ------
    EstimationError
        The start cannot be evaluated.
    """
    if (done := checkpoint.recall(f"{name} optimum")) is not None:
        return _optimum_of(done, keep_all(problem, huber))
    optimum = _optimised(problem, huber, max_iterations, near, checkpoint, name)
    checkpoint.keep(f"{name} optimum", _arrays_of_optimum(optimum))
    for kept in ("approach", *(f"{n}{steps}" for n in range(GATE_ROUNDS) for steps in ("", " freed"))):
        checkpoint.forget(f"{name} {kept}")
    return optimum


def unpulled(problem: Problem, optimum: Optimum) -> Optimum:
    """The optimum with the statics that the measurements tell without the motion prior, and states that follow.

    Where the steps to them do not end it comes back as it was, its covariances too, with a remark.
    """
    if optimum.eased or not optimum.converged or problem.statics.size == 0:
        return optimum
    found = pull.freed(problem, optimum.values, optimum.weights, pull.STEPS)
    if found is None or not found[2]:
        return replace(optimum, remark=pull.NOT_FREED)
    values, used, _, left, cost = found
    used += optimum.iterations
    return replace(optimum, values=values, iterations=used, last_step_sigmas=left, cost=cost, eased=True)


def _optimised(problem: Problem, huber: float, max_iterations: int, near, checkpoint, name) -> Optimum:
    weights = keep_all(problem, huber)
    aside: list[np.ndarray] = []
    if (kept := checkpoint.recall(f"{name} approach")) is not None:
        values, approached = values_of(kept), True
    else:
        values, approached = _approached(problem, weights, max_iterations, near)
        if approached:
            checkpoint.keep(f"{name} approach", arrays_of(values))
    at = Optimum(values, weights, 0, False, np.inf, np.inf)
    for round_ in range(GATE_ROUNDS):
        followed = round_ == 1 and approached
        if round_ and approached:
            # Those whose pictures came or went; without it all took three steps, of 4, 2 and 0.02 sigmas.
            at = replace(at, values=_followed(problem, at.values, weights, 0))
        if not followed:  # of a long log the few pictures in doubt tell nothing about the statics
            irls = 0 if approached or round_ else IRLS_STEPS
            log = Iterations(checkpoint, f"{name} {round_}")
            at = _settled(problem, replace(at, weights=weights), max_iterations, irls, log, approached)
        gated, fits = gates.gross(parts(problem, at.values, weights), problem, weights)
        # Doubted once, at Huber's optimum; what no flip explains comes back for good.
        aside = gates.doubtful(problem, fits) if round_ == 0 else gates.flipped(problem, at.values, aside)
        gated = gates.without(gated, aside)
        settled = not followed and _same(gated, weights)
        if settled or not at.converged or at.iterations >= max_iterations or round_ == GATE_ROUNDS - 1:
            break
        if round_ == 0:
            huber_s = at
        elif _same(gated, huber_s.weights):
            # Nothing gross, and doubted for nothing: that optimum is known.
            return replace(huber_s, iterations=at.iterations)
        weights = gated
    return replace(at, weights=weights)


def _settled(
    problem: Problem, at: Optimum, limit: int, irls: int, log: Iterations, approached: bool
) -> Optimum:
    """Steps of everything with the weights as they are, from where the values are.

    In a long log they are those without the pull of the motion prior: with it, and then without, 100,000 epochs took
    steps of 21, 12 and 0.3 sigmas, and 14, 13 and 0.4 more.
    """
    limit -= at.iterations
    found, eased = None, approached and problem.statics.size > 0
    if eased:
        of_freed = Iterations(log.checkpoint, f"{log.name} freed")
        found = pull.freed(problem, at.values, at.weights, limit, of_freed)
    if found is None:
        eased = False
        found = _iterate(problem, at.values, at.weights, limit, irls, log, near_enough=approached)
    values, used, converged, left, cost = found
    return Optimum(values, at.weights, at.iterations + used, converged, left, cost, eased)


def _arrays_of_optimum(optimum: Optimum) -> Arrays:
    state = [optimum.iterations, optimum.converged, optimum.last_step_sigmas, optimum.cost, optimum.eased]
    return {
        **arrays_of(optimum.values),
        **arrays_of_weights(optimum.weights),
        "state": np.array(state, dtype=float),
    }


def _optimum_of(arrays: Arrays, like: Weights) -> Optimum:
    iterations, converged, sigmas, cost, eased = arrays["state"].tolist()
    values, weights = values_of(arrays), weights_of(arrays, like)
    return Optimum(values, weights, int(iterations), bool(converged), sigmas, np.float64(cost), bool(eased))


def _same(a: Weights, b: Weights) -> bool:
    pairs = [*zip(a.corners, b.corners, strict=True), *zip(a.sensors, b.sensors, strict=True)]
    return all(np.array_equal(*pair) for pair in pairs)


def _approached(
    problem: Problem, weights: Weights, max_iterations: int, near: bool = False
) -> tuple[Values, bool]:
    """The start of a long log with the statics of a sample of it, and states that follow these; and whether it is.

    A start that is near has such statics already.
    """
    taken = approach.sample(problem, weights)
    if taken is None:
        return problem.first, False
    z = problem.first.z
    try:
        if not near:
            short, of_short = taken
            found, _, converged, _, _ = _iterate(short, short.first, of_short, max_iterations, IRLS_STEPS)
            if not converged:
                return problem.first, False
            z = found.z
        return _followed(problem, replace(problem.first, z=z), weights, IRLS_STEPS), True
    except EstimationError:
        return problem.first, False  # what a sample cannot tell, the whole log may


def _followed(problem: Problem, values: Values, weights: Weights, irls: int) -> Values:
    """States that follow the statics as they are.

    Given the statics a state knows nothing of those much before and after it, so spans of the log are adjusted each on
    its own, as if the log ended ``MARGIN`` epochs beyond: each is linearised once per step, and threads share them.
    """
    states = approach.held(problem, values.z)
    z, values = values.z, replace(values, z=states.first.z)
    E = len(problem.epochs.time_ns)

    def moved(span: tuple[int, int]) -> Values:
        a, b = span
        part = part_of(states, values, weights, max(a - MARGIN, 0), min(b + MARGIN, E))
        own = slice(a - part.start, b - part.start)
        try:
            # Its first epoch has the weak prior of a log's: a body that the span does not show stays where it is.
            alone = replace(part.problem, first=part.values, opens=True)
            found, *_ = _iterate(alone, part.values, part.weights, NEAR_STEPS, irls)
        except EstimationError:
            found = part.values  # the whole log may hold what a span does not
        return cut_of(found, own)

    found = threads.each(moved, bounds(problem, SPAN))
    return replace(joined(found), z=z)


def _iterate(
    problem: Problem, values: Values, weights: Weights, limit: int, irls: int,
    log: Iterations = UNKEPT, near_enough=False
):  # fmt: skip
    """Steps until they are short; or, where near is enough, until the next one would be by how the last ones went."""
    E = len(problem.epochs.time_ns)
    stretch = np.arange(E) // STRETCH
    damping = np.zeros(stretch[-1] + 1)
    sigmas, left, converged, used, patient = np.inf, np.inf, False, 0, True
    if (kept := log.recall()) is not None:
        values, damping, used, sigmas, left, converged, patient = kept
    local, prior = cost_of(problem, values, weights)
    if not np.isfinite(local.sum()):
        raise EstimationError(
            "the starting values of the adjustment cannot be evaluated; look at the detections of the first "
            "epochs and at the mounts in machine.toml"
        )
    held = unchecked_statics(problem)
    risky: _Risky | None = None
    while used < limit and not converged:
        used += 1
        step = Step(problem, values, weights, held, newton=used > irls)
        shorten, stale, before = 1.0, True, sigmas
        for attempt in range(TRIES):
            if stale:
                step.solve(damping[stretch])
            if risky is not None and step.pull > 0.25 * risky.pull:
                break
            risky, sigmas = None, step.longest
            trial = step.taken(shorten)
            trial_local, trial_prior = cost_of(problem, trial, weights)
            cost = local.sum() + prior
            change = trial_local.sum() + trial_prior - cost
            rise = np.bincount(stretch, trial_local - local)
            # Rounding of the sum, and what re-weighting may cost, are no reason to damp.
            if change <= 1e-10 * cost + 1e-9:
                patient = True
                break
            risen = rise > max(0.02 * rise.max(), 1e-3)  # the stretches that spoil the step
            if patient and attempt == 0 and change <= PATIENCE * cost and _spread(risen):
                risky = _Risky(values, local, prior, step.pull, risen)
                break
            stale = not _spread(risen)
            if stale:
                damping[risen] = _raised(damping[risen])
            if attempt >= 3 or not stale:
                shorten *= 0.5
        else:
            # No step helps any more: at the bottom to rounding, or stuck, which the sigmas tell.
            return values, used, sigmas < STEP_SIGMAS, sigmas, local.sum() + prior
        if risky is not None and values is not risky.values:
            values, local, prior = risky.values, risky.local, risky.prior
            if not _spread(risky.risen):
                damping[risky.risen] = _raised(damping[risky.risen])
            risky, patient = None, False
            continue
        values = trial
        worse = rise > 0.1 * np.bincount(stretch, local) + 10.0
        local, prior = trial_local, trial_prior
        left = left_after(sigmas, before) if near_enough else sigmas
        converged = bool(left < STEP_SIGMAS and shorten == 1.0 and np.all(damping < 1e-5) and risky is None)
        damping *= DAMPING_DOWN
        damping[damping < DAMPING_NONE] = 0.0
        damping[worse] = np.maximum(damping[worse], DAMPING_FIRST)
        if risky is None:  # else it may be taken back
            log.keep(values, damping, used, sigmas, left, converged, patient)
    if risky is not None and not converged:
        values, local, prior = risky.values, risky.local, risky.prior
    return values, used, converged, left, local.sum() + prior


def _raised(damping):
    return np.clip(damping * DAMPING_UP, DAMPING_FIRST, DAMPING_MOST)


def _spread(risen) -> bool:
    return bool(np.sum(risen) > max(SPREAD * len(risen), SPREAD_OVER))


@dataclass(frozen=True, eq=False)
class _Risky:
    """Where a step began that raised the cost."""

    values: Values
    local: np.ndarray
    prior: float
    pull: float
    risen: np.ndarray
    """(stretches,) bool: where it rose."""
