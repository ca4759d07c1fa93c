"""A log cut into parts of a few thousand epochs, which are all that is linearised at one time.

A part is a problem of its own, over the epochs ``start`` to ``stop - 1``, and its *far end*, the first epoch of the
part that follows: that epoch's state stands at the other end of the last motion residual, its observations belong to
the part that follows. Whatever can be asked of a whole problem can be asked of a part.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.estimation.problem import Problem, Weights
from pipeline.estimation.values import Values

PART_EPOCHS = 1024
"""The blocks of one part are some 8 MB, which caches hold, and several are in memory, as threads work ahead; 288,000
epochs in one piece took 5.6 GB and a third longer. Smaller parts pay more for each call than for the arithmetic."""


@dataclass(frozen=True, eq=False)
class Part:
    """One stretch of a log's problem at given values."""

    start: int
    stop: int
    problem: Problem
    values: Values
    weights: Weights

    @property
    def epochs(self) -> int:
        """How many are its own, without the far end."""
        return self.stop - self.start

    @property
    def with_far_end(self) -> slice:
        """Its epochs and the far end among those of the log."""
        return slice(self.start, self.start + len(self.problem.epochs.time_ns))

    @property
    def own_values(self) -> Values:
        """Without the far end."""
        return cut(self.values, slice(0, self.epochs))


def bounds(problem: Problem, size: int = PART_EPOCHS) -> list[tuple[int, int]]:
    """First epoch of each part, and the one after its last."""
    E = len(problem.epochs.time_ns)
    return [(a, min(a + size, E)) for a in range(0, E, size)]


def part_of(problem: Problem, values: Values, weights: Weights, start: int, stop: int) -> Part:
    """The part from one epoch up to another."""
    E = len(problem.epochs.time_ns)
    if (start, stop) == (0, E):
        return Part(start, stop, problem, values, weights)
    span = slice(start, min(stop + 1, E))
    between = slice(start, span.stop - 1)
    corners, kept = _rows(problem.corners, weights.corners, start, stop)
    sensors, read = _rows(problem.sensors, weights.sensors, start, stop)
    return Part(
        start,
        stop,
        replace(
            problem,
            epochs=replace(problem.epochs, time_ns=problem.epochs.time_ns[span]),
            corners=corners,
            sensors=sensors,
            first=cut(problem.first, span),
            dt_s=problem.dt_s[between],
            densities=tuple(q[between] for q in problem.densities),
            opens=problem.opens and start == 0,
        ),
        cut(values, span),
        replace(weights, corners=kept, sensors=read),
    )


def _rows(groups, alive, start: int, stop: int):
    """Groups of measurements, and their weights, of some epochs: every array of a group has one row per measurement."""
    cut_groups, cut_alive = [], []
    for group, of_group in zip(groups, alive, strict=True):
        rows = slice(*np.searchsorted(group.epoch, [start, stop]))
        arrays = {f.name: getattr(group, f.name) for f in fields(group)}
        arrays = {name: a[rows] for name, a in arrays.items() if isinstance(a, np.ndarray)}
        arrays["epoch"] = arrays["epoch"] - start
        cut_groups.append(replace(group, **arrays))
        cut_alive.append(of_group[rows])
    return tuple(cut_groups), tuple(cut_alive)


def cut(values: Values, span: slice) -> Values:
    """The states of some epochs, with all statics."""
    return replace(
        values,
        pose=tuple(T[span] for T in values.pose),
        rate=tuple(w[span] for w in values.rate),
        time_s=values.time_s[span],
    )


def joined(values: list[Values]) -> Values:
    """The states of parts, one after the other, with the statics of the first."""
    return replace(
        values[0],
        pose=tuple(np.concatenate(T) for T in zip(*(v.pose for v in values), strict=True)),
        rate=tuple(np.concatenate(w) for w in zip(*(v.rate for v in values), strict=True)),
        time_s=np.concatenate([v.time_s for v in values]),
    )
