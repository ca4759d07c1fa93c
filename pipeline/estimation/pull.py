"""The pull of the motion prior on the statics, and the statics without it.

At the optimum of eq. (2) the motion prior speaks of the statics too, though a machine moves by no camera's leave:
statics with which the states can follow the noise of the corners a little further, or with which the path is a little
stiller, cost less. With statics ``z`` near their truth the mean cost of the best states is, to second order,

    const  -  ½ tr(H_xx^-1 J_x'J_x)  +  ½ |motion residuals of the true path as z shows it|²

with ``J_x`` the measurements' Jacobian. Both slopes by ``z`` grow with the log while the sigmas of ``z`` fall. Were
paths drawn from the prior, ``½ log |H_xx|`` would balance them; an excavator's path is far smoother, and that is five
times too much. In the drawn log of ``benchmarks.adjustment``, where one camera sees a free body and only the second
differences of perspective tell the centre of its picture, the pull is 1.8e-4 an epoch, measured and by the formula: at
60,000 epochs a principal point was off by 6.7 px with a sigma of 0.75. With motion densities a thousandth of these it
is ten times as strong.

So the statics ask the measurements alone. With ``H_k`` the states' information under densities of motion that are ``k``
times larger, and ``r`` the measurements' residuals at the states as the true prior smooths them,

    s = (J_z - J_x H_k^-1 J_x'J_z)' r + z = 0             S = I + J_z' (J_z - J_x H_k^-1 J_x'J_z)

The bracket is at right angles to ``J_x`` but for a k-th, at whatever states it is taken; so neither the smoothing nor
the noise of the states moves ``s``. No k is needed where one instant shows all of a state; it keeps what neighbouring
pictures and readings tell together. ``S^-1`` is the covariance, and states follow by ``dx = -H^-1 (g + B dz)`` as ever.
Tried before: taking ``½ tr(H_xx^-1 J_x'J_x)`` off the cost, which needs a pass for every static and leaves the other
slope; densities a hundred times larger throughout, with which the first slope stays as it was (NEES 128).
"""

from __future__ import annotations

import numpy as np

from pipeline.errors import EstimationError
from pipeline.estimation.checkpoint import UNKEPT, Iterations
from pipeline.estimation.gauss_newton import STEP_SIGMAS, Step, left_after
from pipeline.estimation.linearised import cost_of
from pipeline.estimation.problem import Problem, Weights, unchecked_statics
from pipeline.estimation.values import Values

EASE = 1e3
"""Of the pull 25 % is left with 10, 6 % with 100, 2 % with this and with 1e6. Sigmas of statics rise by 0.5 % at most
in networks d, f and g, by 2.5 % for the time offset of a sensor that reads between the pictures, and by 18 % for mounts
and lenses of two cameras that take turns on a shaking cab for a minute (the edge's common part: 2 %)."""
STEPS, LONGER = 8, 2.0
"""Steps at the most, and how many times as long as the one before one may be. Two or three are enough at 60 epochs and
at 60,000. The second is often as long as the first, all of it in the states: the statics' first step bends the pictures
of the whole log, and they mend that."""
NOT_FREED = (
    "lenses, mounts and sensor curves still feel the motion prior, for the steps that free them of it did not end: "
    "in a long log they may be off by more than their sigmas say"
)


def freed(
    problem: Problem, values: Values, weights: Weights, limit: int, log: Iterations = UNKEPT
) -> tuple[Values, int, bool, float, float] | None:
    """Newton's steps to the statics that the measurements tell without the motion prior, and to states that follow.

    They do not fall to a minimum, so no cost can judge them: they must end by getting short. None where they do not;
    nor could the covariances be had there.

    Returns
    -------
    values : Values
    used : int
        Steps taken, `limit` at the most.
    converged : bool
    left : float
        Length of the next step in posterior sigmas, as far as the last two tell.
    cost : float
        Of everything, the motion prior too.
    """
    held, undamped = unchecked_statics(problem), np.zeros(len(problem.epochs.time_ns))
    used, before, left, converged = 0, np.inf, np.inf, False
    if (kept := log.recall()) is not None:
        values, _, used, before, left, converged, _ = kept
    while used < limit and not converged:
        step = Step(problem, values, weights, held, newton=True, ease=EASE)
        try:
            step.solve(undamped)
        except EstimationError:
            return None
        if np.any(step.damping) or step.longest > LONGER * before or used == STEPS:
            return None
        values, used = step.taken(1.0), used + 1
        left = left_after(step.longest, before)
        before, converged = step.longest, left < STEP_SIGMAS
        log.keep(values, undamped, used, before, left, converged, True)
    local, prior = cost_of(problem, values, weights)
    return values, used, converged, left, float(local.sum() + prior)
