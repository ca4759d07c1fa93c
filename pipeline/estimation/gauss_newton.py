"""A Gauss-Newton step of everything: the states and statics of a whole log at once, a part of it at a time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from pipeline import threads
from pipeline.errors import EstimationError
from pipeline.estimation import sweeps
from pipeline.estimation.linearised import KEPT_PARTS, parts, pieces
from pipeline.estimation.normal import linearised_along
from pipeline.estimation.parts import Part, joined
from pipeline.estimation.problem import Problem, Weights
from pipeline.estimation.values import Values

STEP_SIGMAS = 0.05
"""Converged when no unknown moves by more of its posterior sigma; see ``sweeps.Reduced.longest``."""
HOLD = 1e12
"""Information that keeps an unchecked static where it is during the steps; a prior is 1. Not for covariances."""


def deltas_of(problem: Problem, dx) -> list[np.ndarray]:
    """Chain steps, cut up by variable."""
    places = [problem.place(k) for k in range(len(problem.tie.variables))]
    return [dx[c][:, at] for c, at in places]


class Step:
    """The Gauss-Newton step at one point, solved for as often as the damping changes.

    With ``ease`` its statics' part is that of ``pull``, and the states follow.
    """

    def __init__(
        self,
        problem: Problem,
        values: Values,
        weights: Weights,
        held,
        newton: bool,
        ease: float | None = None,
    ):
        self.problem, self.values = problem, values
        self.cut = cut = parts(problem, values, weights)
        self.damping = damping = np.zeros(len(problem.epochs.time_ns))

        def finish(i: int, piece: sweeps.Piece) -> sweeps.Piece:
            # Knows nothing of self: in a cycle with it, the parts of every step so far would wait for the collector.
            C = piece.C
            if i == 0 and len(held):
                C = C.copy()
                C[held, held] += HOLD
            return replace(piece, C=C, damping=damping[cut[i].with_far_end])

        self.pieces, self.eased = pieces(cut, newton, finish, ease), ease is not None

        def follow(dz, i: int) -> sweeps.Piece:
            of = cut[i]
            chains = linearised_along(of.problem, of.values, of.weights, dz, newton)
            return sweeps.Piece(tuple(chains), dz[:0], dz[:0], of.epochs, damping[of.with_far_end])

        # A short log is linearised once. Without a border there is nothing to spare either.
        self.follow = None if len(cut) <= KEPT_PARTS or not problem.statics.size else follow

    def solve(self, damping) -> None:
        """Solve; where rounding leaves the matrix indefinite, everything is damped a little."""
        for extra in (0.0, 1e-9, 1e-6, 1e-3):
            self.damping[:] = damping + extra
            try:
                if self.eased:
                    reduced, alone = sweeps.reduce_twice(self.pieces, len(self.cut))
                    reduced = replace(reduced, dz=alone.dz, pull=alone.pull)
                else:
                    reduced = sweeps.reduce(self.pieces, len(self.cut))
            except np.linalg.LinAlgError:
                continue
            break
        else:
            raise EstimationError(
                "the normal equations of this log cannot be solved: measurements contradict each other beyond what "
                "the stated sigmas allow, or a sigma in machine.toml or site.toml is wrong by orders of magnitude"
            )
        self.dz, self.longest, self.pull = reduced.dz, reduced.longest, reduced.pull
        E = len(self.problem.epochs.time_ns)
        self.deltas = [np.empty((E, v.size)) for v in self.problem.tie.variables]
        following = self.pieces if self.follow is None else partial(self.follow, reduced.dz)
        for i, dx in sweeps.steps(following, reduced):
            part = self.cut[i]
            for delta, of_part in zip(self.deltas, deltas_of(self.problem, dx), strict=True):
                delta[part.start : part.stop] = of_part[: part.epochs]

    def taken(self, shorten: float) -> Values:
        """The values after a share of the step."""

        def moved_part(part: Part) -> Values:
            return part.own_values.retract([shorten * d[part.start : part.stop] for d in self.deltas], 0.0)

        moved = joined(threads.each(moved_part, self.cut))
        return replace(moved, z=self.values.z + shorten * self.dz)


def left_after(sigmas: float, before: float) -> float:
    """Length of the next step: as much shorter than this one as this is than the one before, infinite for a first."""
    return sigmas * min(sigmas / before, 1.0) if np.isfinite(before) else sigmas
