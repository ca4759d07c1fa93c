"""Normal equations and cost of a whole log, part by part: linearised where they are asked for, never all at once."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from pipeline import threads
from pipeline.estimation import sweeps
from pipeline.estimation.arrow import Chain
from pipeline.estimation.normal import cost_by_epoch, linearise, linearise_twice
from pipeline.estimation.parts import Part, bounds, part_of
from pipeline.estimation.problem import Problem, Weights
from pipeline.estimation.values import Values

KEPT_PARTS = 4


def parts(problem: Problem, values: Values, weights: Weights) -> list[Part]:
    """All parts of a log, in order."""
    return [part_of(problem, values, weights, a, b) for a, b in bounds(problem)]


def pieces(
    cut: list[Part],
    newton=False,
    finish: Callable[[int, sweeps.Piece], sweeps.Piece] | None = None,
    ease: float | None = None,
) -> sweeps.Pieces:
    """Normal equations of the parts, when they are asked for; ``newton`` and ``ease`` are those of ``linearise_twice``.

    The last few stay: sweep two begins where sweep one ends, and a short log is linearised once.
    """
    kept: dict[int, sweeps.Piece] = {}
    bookkeeping = Lock()

    def piece(i: int) -> sweeps.Piece:
        found = kept.get(i)
        if found is None:
            part = cut[i]
            at = part.problem, part.values, part.weights
            eased: list[Chain] = []
            if ease is None:
                chains, C, g_z = linearise(*at, newton)
            else:
                chains, eased, C, g_z = linearise_twice(*at, ease, newton)
            found = sweeps.Piece(tuple(chains), C, g_z, part.epochs, eased=tuple(eased))
            with bookkeeping:  # several threads ask
                while len(kept) >= KEPT_PARTS:
                    kept.pop(next(iter(kept)))
                kept[i] = found
        return finish(i, found) if finish else found

    return piece


def cost_of(problem: Problem, values: Values, weights: Weights):
    """``cost_by_epoch`` of the whole log, part by part."""
    local, prior = np.zeros(len(problem.epochs.time_ns)), 0.0
    cut = parts(problem, values, weights)
    costs = threads.each(lambda part: cost_by_epoch(part.problem, part.values, part.weights), cut)
    for part, (of_part, of_statics) in zip(cut, costs, strict=True):
        local[part.start : part.stop] = of_part[: part.epochs]
        prior += of_statics
    return local, prior
