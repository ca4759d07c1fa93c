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

from dataclasses import replace

import numpy as np

from pipeline.errors import EstimationError
from pipeline.estimation import optimise
from pipeline.estimation.linearised import cost_of
from pipeline.estimation.problem import Problem, unchecked_statics

EASE = 1e3
"""Of the pull 25 % is left with 10, 6 % with 100, 2 % with this and with 1e6. Sigmas of statics rise by 0.5 % at most
in networks d, f and g, by 2.5 % for the time offset of a sensor that reads between the pictures, and by 18 % for mounts
and lenses of two cameras that take turns on a shaking cab for a minute (the edge's common part: 2 %)."""
STEPS = 8
"""At most; two or three are enough at 60 epochs and at 60,000."""
NOT_FREED = (
    "lenses, mounts and sensor curves still feel the motion prior, for the steps that free them of it did not end: "
    "in a long log they may be off by more than their sigmas say"
)


def unpulled(problem: Problem, optimum: optimise.Optimum) -> optimise.Optimum:
    """The optimum with the statics that the measurements tell without the motion prior, and states that follow.

    Newton's steps from the optimum of everything: they do not fall to a minimum, so no cost can judge them, but they
    are short. Where they do not end it comes back as it was, its covariances too, with a remark.
    """
    if not optimum.converged or problem.statics.size == 0:
        return optimum
    held, values = unchecked_statics(problem), optimum.values
    undamped, before = np.zeros(len(problem.epochs.time_ns)), optimise.STEP_SIGMAS
    for n in range(STEPS):
        step = optimise.Step(problem, values, optimum.weights, held, newton=True, ease=EASE)
        try:
            step.solve(undamped)
        except EstimationError:
            break
        if np.any(step.damping):  # nor could the covariances be had
            break
        values = step.taken(1.0)
        left = optimise.left_after(step.longest, before)
        if left < optimise.STEP_SIGMAS:
            local, prior = cost_of(problem, values, optimum.weights)
            return replace(
                optimum,
                values=values,
                iterations=optimum.iterations + n + 1,
                last_step_sigmas=left,
                cost=float(local.sum() + prior),
                eased=True,
            )
        before = step.longest
    return replace(optimum, remark=NOT_FREED)
