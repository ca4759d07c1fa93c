"""The start of a long log, brought near its optimum before the whole of it is asked about its statics.

Cameras and benchmarks are off their files' values by a sigma or so, which is tens of pixels; and the longer the log,
the more exactly its optimum is known. From the start of ``network.start`` a log of 10,000 epochs took 5 steps, one of
100,000 8, and at 288,000 Newton's third step failed in every stretch, for with wrong statics nearly all corners are
beyond the threshold: after 20 iterations of 11 s it was still 600 sigma off. So first a sample of the log tells the
statics, then all states follow with these statics held, which needs no border; then three steps of everything remain.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from pipeline.estimation.problem import Problem, Weights
from pipeline.estimation.values import Statics, Values

STRETCH = 256
"""Epochs of a stretch of the sample: longer than most gaps, so that bodies are tied to each other in it."""
SPREAD = 16
"""Stretches that lie evenly over the log."""
OF_GROUP = 4
"""Stretches that lie evenly over the sightings of each camera and marker, and over the readings of each sensor."""
WORTH = 3
"""A sample is taken of logs that are longer than so many samples."""
SEAM_S, SEAM_DENSITY = 1.0, np.array([1e4, 0.0])
"""Between stretches motion is taken as over a second, with a density of acceleration (m²/s³ and rad²/s³) that no
machine has: it ties nothing, and keeps a body in reach that a stretch does not show."""


def sample(problem: Problem, weights: Weights) -> tuple[Problem, Weights] | None:
    """A short log of stretches of this one, its statics the same; None where the log is short itself."""
    E = len(problem.epochs.time_ns)
    picked = [_spread(E, SPREAD)]
    for seen in (*(g.epoch for g in problem.corners), *(s.epoch for s in problem.sensors)):
        at = np.linspace(0, len(seen) - 1, OF_GROUP + 2)[1:-1].astype(np.int64)
        picked.append(seen[at] // STRETCH if len(seen) else at[:0])
    chosen = np.unique(np.concatenate(picked))
    if WORTH * STRETCH * len(chosen) >= E:
        return None
    return of_stretches(problem, weights, _epochs(E, chosen))


def stretches(problem: Problem, count: int) -> np.ndarray:
    """Epochs of at most so many stretches that lie evenly over the log."""
    E = len(problem.epochs.time_ns)
    return _epochs(E, np.unique(_spread(E, count)))


def _spread(E: int, count: int):
    return np.linspace(0, -(-E // STRETCH) - 1, count).astype(np.int64)


def _epochs(E: int, chosen):
    epochs = (chosen[:, None] * STRETCH + np.arange(STRETCH)).ravel()
    return epochs[epochs < E]


def of_stretches(problem: Problem, weights: Weights, epochs) -> tuple[Problem, Weights]:
    """The log of some epochs only, rising; nothing is tied across those that are left out."""
    E = len(problem.epochs.time_ns)
    corners, kept = _rows(problem.corners, weights.corners, epochs, E)
    sensors, read = _rows(problem.sensors, weights.sensors, epochs, E)
    seam = np.diff(epochs) > 1
    before = epochs[:-1]
    return (
        replace(
            problem,
            epochs=replace(problem.epochs, time_ns=problem.epochs.time_ns[epochs]),
            corners=corners,
            sensors=sensors,
            first=at_epochs(problem.first, epochs),
            dt_s=np.where(seam, SEAM_S, problem.dt_s[before]),
            densities=tuple(
                np.where(seam[:, None, None], SEAM_DENSITY, q[before]) for q in problem.densities
            ),
        ),
        replace(weights, corners=kept, sensors=read),
    )


def at_epochs(values: Values, epochs) -> Values:
    """The states of some epochs, with all statics."""
    return replace(
        values,
        pose=tuple(T[epochs] for T in values.pose),
        rate=tuple(w[epochs] for w in values.rate),
        time_s=values.time_s[epochs],
    )


def _rows(groups, alive, epochs, E: int):
    """Groups of measurements, and their weights, at some epochs, which are counted anew."""
    new = np.full(E, -1)
    new[epochs] = np.arange(len(epochs))
    cut_groups, cut_alive = [], []
    for group, of_group in zip(groups, alive, strict=True):
        rows = new[group.epoch] >= 0
        arrays = {f.name: getattr(group, f.name) for f in fields(group)}
        arrays = {name: a[rows] for name, a in arrays.items() if isinstance(a, np.ndarray)}
        arrays["epoch"] = new[arrays["epoch"]]
        cut_groups.append(replace(group, **arrays))
        cut_alive.append(of_group[rows])
    return tuple(cut_groups), tuple(cut_alive)


def held(problem: Problem, z) -> Problem:
    """The problem with its statics held at ``z``, except the clocks: what a state is, is said in their time."""
    statics = problem.statics
    clocks = {c for c in statics.clocks if c is not None}
    base, scale, columns, free = [], [], [], []
    size = 0
    for k, old in enumerate(statics.columns):
        if k in clocks:
            base.append(statics.base[k])
            scale.append(statics.scale[k])
            columns.append(size + np.arange(len(old)))
            free.append(old)
            size += len(old)
        else:
            base.append(statics.value(k, z))
            scale.append(statics.scale[k][:, :0])
            columns.append(old[:0])
    kept = z[np.concatenate(free)] if free else z[:0]
    return replace(
        problem,
        statics=Statics(tuple(base), statics.is_pose, tuple(scale), tuple(columns), statics.clocks, size),
        first=replace(problem.first, z=kept),
    )
