"""Spectral densities of the motion prior, learned from the log: how much each body accelerates, by what it is doing.

The marginal likelihood of a density ``q`` is stationary where (MacKay 1992, for evidence of a Gaussian prior)

    q_new = q sum |e|² / (N - T),      T = sum tr(J P J')

with ``e`` the ``N`` components of the whitened motion residuals at the smoothed states, ``J`` their Jacobians and ``P``
the covariance of neighbouring states: ``N - T`` of the increments were measured, the rest the prior made up. Plain
expectation-maximisation, ``q (sum |e|² + T) / N``, has the same fixed point but needs hundreds of rounds at
15 readings a second, where a single increment is next to unmeasured and ``T`` is nearly ``N``.

One density for a shift would be the mean of work and rest; so the intervals of a body are sorted first: **parked**
where the pictures and readings of two seconds show nothing but noise, **tramming** where it travels, else **working**.

Finer sorting was tried, with a level of its own for every three seconds: a cab that shakes at up to 4 Hz, filmed at
5 Hz, then got an own sigma of 2.3 mm at the edge where it was 4.5 mm off. What lies above half the frame rate is folded
into what is seen as slow motion, and no likelihood of the pictures brings it back; the mean over work, with its swings,
states 4.1 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from pipeline.estimation import motion
from pipeline.estimation.marginals import Marginals
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem, motion_residual
from pipeline.estimation.values import Values
from pipeline.network import frames as fr

CLASSES = ("working", "parked", "tramming")
WINDOW_S = 2.0
STILL_SIGMAS = 7.0
"""Range of a corner's coordinate over the window, in its sigmas, below which nothing moved: of twenty normal draws
it is 3.7 on average, and 6.2 once in a hundred for the widest of eight."""
TRAM_M, TRAM_S = 1.0, 5.0
"""A body whose origin gets further than this in the world in this time is tramming; a swing turns it on the spot."""
ENOUGH = 10.0
"""Measured increments below which a class keeps the density it has: ten tell a variance to a factor of 1.5. With 30,
ten seconds at rest kept the density of work, since at rest hardly an increment is measured."""
FASTEST = 30.0
"""Factor by which a density may move in one round: the states are linear in it only so far."""
LEAST_SHARE = 1e-6
"""Of the configured density. Parked, the pictures cannot tell less from nothing, and the blocks' condition suffers."""


@dataclass(frozen=True, eq=False)
class Densities:
    """Spectral densities of one variable."""

    label: np.ndarray
    """(E - 1,) index into ``CLASSES`` of each interval."""
    density: np.ndarray
    """(3, 2) by class: translation m²/s³ (1 for a joint, unused) and rotation rad²/s³."""
    measured: np.ndarray
    """(3, 2) how many increments of each were measured, ``N - T``; 0 before anything was learned."""

    def roots(self, kind: str):
        """(E - 1, h), for ``Problem.roots``."""
        table = np.array([motion.root_density(kind, tuple(row)) for row in self.density])
        return table[self.label]


def configured(problem: Problem, values: Values) -> list[Densities]:
    """Every interval sorted, with the densities of machine.toml: the start."""
    out = []
    for k, variable in enumerate(problem.tie.variables):
        label = np.where(parked(problem, k), 1, 0)
        frame = fr.body_frame(variable.body)
        if variable.kind == "moving" and problem.tie.frames.edges[frame].parent == fr.WORLD:
            label[tramming(problem, values, k)] = 2
        table = np.tile(np.asarray(variable.motion, dtype=float), (len(CLASSES), 1))
        out.append(Densities(label, table, np.zeros_like(table)))
    return out


class Increments:
    """What the smoothed increments say of the densities, summed by variable, class and part of the motion."""

    def __init__(self, problem: Problem, now: list[Densities]):
        self.problem, self.now = problem, now
        self.total = [np.zeros((len(CLASSES), 2)) for _ in now]
        """Sums of squares of the whitened motion residuals."""
        self.known = [np.zeros((len(CLASSES), 2)) for _ in now]
        """``N - T``."""

    def add(self, part: Part, found: Marginals) -> None:
        """The increments of a part of the log, and that to the part that follows."""
        for k, (variable, now) in enumerate(zip(self.problem.tie.variables, self.now, strict=True)):
            square, trace = _increments(part.problem, part.values, found, k)
            label = now.label[part.start : part.start + len(square)]
            halves = (
                {1: [0, 1]} if variable.kind == "joint" else {0: [0, 1, 2, 6, 7, 8], 1: [3, 4, 5, 9, 10, 11]}
            )
            for half, columns in halves.items():
                for c in range(len(CLASSES)):
                    rows = np.flatnonzero(label == c)
                    self.known[k][c, half] += float(np.sum(1 - trace[rows][:, columns]))
                    self.total[k][c, half] += float(np.sum(square[rows][:, columns]))

    def learned(self) -> list[Densities]:
        """One round: densities at which the marginal likelihood of these states is stationary."""
        out = []
        for k, variable in enumerate(self.problem.tie.variables):
            old, known, total = self.now[k], self.known[k], self.total[k]
            density = old.density.copy()
            for half in (1,) if variable.kind == "joint" else (0, 1):
                for c in range(len(CLASSES)):
                    if known[c, half] < ENOUGH:
                        continue
                    factor = np.clip(total[c, half] / known[c, half], 1 / FASTEST, FASTEST)
                    floor = LEAST_SHARE * variable.motion[half]
                    density[c, half] = max(density[c, half] * factor, floor)
            out.append(Densities(old.label, density, np.maximum(known, 0.0)))
        return out


def moved_by(old: list[Densities], new: list[Densities]) -> float:
    """Largest ratio between two rounds of any density that was measured, at least 1."""
    worst = 1.0
    for a, b in zip(old, new, strict=True):
        use = b.measured >= ENOUGH
        if np.any(use):
            worst = max(worst, float(np.exp(np.abs(np.log(b.density[use] / a.density[use])).max())))
    return worst


def described(problem: Problem, densities: list[Densities]) -> dict:
    """For solution.json: by body and class its seconds, densities, and how many increments told them."""
    out: dict = {}
    for variable, found in zip(problem.tie.variables, densities, strict=True):
        parts = ("rotation",) if variable.kind == "joint" else ("translation", "rotation")
        column = {"translation": 0, "rotation": 1}
        entry: dict = {"configured": {p: float(variable.motion[column[p]]) for p in parts}}
        for c, name in enumerate(CLASSES):
            here = found.label == c
            if not np.any(here):
                continue
            entry[name] = {"seconds": round(float(problem.dt_s[here].sum()), 2)} | {
                p: {
                    "density": float(f"{found.density[c, column[p]]:.4g}"),
                    "measured": round(float(found.measured[c, column[p]]), 1),
                    "learned": bool(found.density[c, column[p]] != variable.motion[column[p]]),
                }
                for p in parts
            }
        out[variable.body] = entry
    return out


def spells(problem: Problem, densities: list[Densities]) -> dict[str, list[dict]]:
    """For solution.json: what each body that stands in the world did, one spell after the other.

    What lasts for less than ``WINDOW_S`` is no spell of its own, and goes with the one before it.
    """
    out: dict[str, list[dict]] = {}
    time_ns = problem.epochs.time_ns
    for variable, found in zip(problem.tie.variables, densities, strict=True):
        standing = problem.tie.frames.edges[fr.body_frame(variable.body)].parent == fr.WORLD
        if variable.kind != "moving" or not standing or len(found.label) == 0:
            continue
        starts = np.r_[0, np.flatnonzero(np.diff(found.label)) + 1]
        told: list[dict] = []
        for a, b in zip(starts, np.r_[starts[1:], len(found.label)], strict=True):
            name, long = CLASSES[found.label[a]], time_ns[b] - time_ns[a] >= 1e9 * WINDOW_S
            if told and (told[-1]["class"] == name or not long):
                told[-1]["to_ns"] = int(time_ns[b])
            else:
                told.append({"class": name, "from_ns": int(time_ns[a]), "to_ns": int(time_ns[b])})
        out[variable.body] = told
    return out


def _increments(problem: Problem, values: Values, found: Marginals, k: int):
    """Squares of the whitened motion residuals of a variable and their posterior variances, (E - 1, 2h) each."""
    c, at = problem.place(k)
    e, A, B = motion_residual(problem, values, k)
    assert A is not None and B is not None
    Z = found.Z[c][:, at, at]
    Z_12 = -(found.G[c] @ found.Z[c][1:])[:, at, at]
    trace = np.sum((A @ Z[:-1]) * A, axis=-1) + np.sum((B @ Z[1:]) * B, axis=-1)
    trace += 2 * np.sum((A @ Z_12) * B, axis=-1)
    return e**2, np.clip(trace, 0.0, 1.0)


def parked(problem: Problem, k: int):
    """(E - 1,) bool: between two epochs at which everything that shows this variable shows nothing but noise.

    Only the pictures that show least else count: a stick at rest is not in motion because the bucket on it turns.
    """
    E = len(problem.dt_s) + 1
    met = {id(g): {s.edge.index for s in g.path if s.edge.kind != "static"} for g in problem.corners}
    with_k = [g for g in problem.corners if k in met[id(g)]]
    fewest = min((len(met[id(g)]) for g in with_k), default=0)
    still, seen = np.ones(E, dtype=bool), np.zeros(E, dtype=bool)
    seen_obs = problem.epochs.observations
    for group in with_k:
        if len(met[id(group)]) > fewest:
            continue
        for tag in np.unique(seen_obs.tag[group.rows]):
            rows = seen_obs.tag[group.rows] == tag
            epoch = group.epoch[rows]
            sigma = np.sqrt(np.einsum("nkii->nki", seen_obs.cov[group.rows[rows]]))
            here = _quiet(group.uv[rows].reshape(len(epoch), 8), sigma.reshape(len(epoch), 8),
                          problem.epochs.time_s[epoch])  # fmt: skip
            still[epoch] &= here
            seen[epoch] = True
    for readings in problem.sensors:
        if readings.variable == k:
            sigma = np.full((len(readings.raw), 1), max(readings.sensor.noise, 1e-12))
            here = _quiet(readings.raw[:, None], sigma, problem.epochs.time_s[readings.epoch])
            np.logical_and.at(still, readings.epoch, here)
            seen[readings.epoch] = True
    at = np.flatnonzero(seen)
    if len(at) < 2:
        return np.zeros(E - 1, dtype=bool)
    # An interval is parked where the last sighting before it and the first one after it are.
    before = at[np.clip(np.searchsorted(at, np.arange(E - 1), side="right") - 1, 0, None)]
    after = at[np.clip(np.searchsorted(at, np.arange(1, E)), None, len(at) - 1)]
    near = problem.epochs.time_s[after] - problem.epochs.time_s[before] < WINDOW_S
    return still[before] & still[after] & near


def _quiet(values, sigma, time_s):
    """(n,) bool: the range of every column over the window around each row is that of noise."""
    if len(values) < 4:
        return np.zeros(len(values), dtype=bool)
    width = max(3, round(WINDOW_S / max(float(np.median(np.diff(time_s))), 1e-3)) | 1)
    width = min(width, 2 * len(values) - 1)
    span = maximum_filter1d(values, width, axis=0, mode="nearest") - minimum_filter1d(
        values, width, axis=0, mode="nearest"
    )
    return np.all(span < STILL_SIGMAS * sigma, axis=1)


def tramming(problem: Problem, values: Values, k: int):
    """(E - 1,) bool: the body's origin gets further than ``TRAM_M`` in ``TRAM_S`` around the interval."""
    t = problem.epochs.time_s
    p = values.pose[k][:, :3, 3]
    a = np.searchsorted(t, t[:-1] - TRAM_S / 2)
    b = np.minimum(np.searchsorted(t, t[1:] + TRAM_S / 2), len(t) - 1)
    return (np.linalg.norm(p[b] - p[a], axis=1) > TRAM_M) & (t[b] - t[a] < 2 * TRAM_S)
