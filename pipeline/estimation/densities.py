"""Spectral densities of the motion prior, learned from the log: how much each body accelerates and shakes.

Two causes move a component between two epochs: white noise on acceleration, of density ``a``, which is work, and white
noise on velocity, of density ``v``, which is shaking (``motion``). Each has its part of an increment's covariance,
``Q = Q_a + Q_v``; the marginal likelihood of the densities is stationary where (MacKay 1992, for one cause)

    q_new = q sum e'M e / (sum tr M - T),      M = W Q_q W',      T = sum tr(M J P J')

with ``e`` the whitened motion residuals at the smoothed states, ``W'W = Q^-1``, ``J`` their Jacobians and ``P`` the
covariance of neighbouring states: ``tr M - T`` of the increments were measured, the rest the prior made up. Plain
expectation-maximisation has the same fixed point but needs hundreds of rounds at 15 readings a second, where a single
increment is next to unmeasured and ``T`` is nearly all.

Every component accelerates by a density of its own: a cab turns about its vertical axis, not about the others. It
shakes by one for three axes: with one for each, intervals of the sample, of whose cab's rocking much lies near the
frame rate, held 89.3 % where they now hold 91.7 %. With acceleration alone, and one density for three axes, a cab that
shakes at up to 4 Hz, filmed at 5 Hz, had an edge that scattered by 5.8 mm and a stated own part of 4.1 mm; now 5.1 and
5.6 mm. Levels of acceleration by three seconds were tried too: they stated 2.3 mm, since what lies above half the frame
rate is folded into slow motion.

One density for a shift would be the mean of work and rest; so the intervals of a body are sorted first: **parked**
where the pictures and readings of two seconds show nothing but noise, **tramming** where it travels, else **working**.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from pipeline.estimation import motion
from pipeline.estimation.marginals import Marginals
from pipeline.estimation.parts import Part
from pipeline.estimation.problem import Problem, motion_residual
from pipeline.estimation.values import Values
from pipeline.network import frames as fr

CLASSES = ("working", "parked", "tramming")
PARKED = CLASSES.index("parked")
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
SHAKE_S = 0.1
"""At the start a body shakes as much as it works over this time, a frame or less."""


@dataclass(frozen=True, eq=False)
class Densities:
    """Spectral densities of one variable."""

    label: np.ndarray
    """(E - 1,) index into ``CLASSES`` of each interval."""
    density: np.ndarray
    """(3, h, 2) by class and component: of acceleration, m²/s³ or rad²/s³, and of velocity, m²/s or rad²/s."""
    measured: np.ndarray
    """(3, h) how many increments of each were measured; 0 before anything was learned."""

    def by_interval(self):
        """(E - 1, h, 2), for ``Problem.densities``."""
        return self.density[self.label]

    def spread(self):
        """(3, h) what both add to a position in ``SHAKE_S``."""
        return self.density[..., 0] * SHAKE_S**3 / 3 + self.density[..., 1] * SHAKE_S


def shaking(problem: Problem) -> Problem:
    """The problem with bodies that shake as much as they work over ``SHAKE_S``: where learning starts."""
    both = np.array([1.0, SHAKE_S**2 / 3])
    return replace(problem, densities=tuple(q[..., :1] * both for q in problem.densities))


def configured(problem: Problem, values: Values, window_s: float = WINDOW_S) -> list[Densities]:
    """Every interval sorted, with the densities of the problem: the start. Parked is what is still for a window."""
    out = []
    for k, variable in enumerate(problem.tie.variables):
        label = np.where(parked(problem, k, window_s), PARKED, 0)
        frame = fr.body_frame(variable.body)
        if variable.kind == "moving" and problem.tie.frames.edges[frame].parent == fr.WORLD:
            label[tramming(problem, values, k)] = 2
        table = np.tile(problem.densities[k][:1], (len(CLASSES), 1, 1))
        out.append(Densities(label, table, np.zeros(table.shape[:2])))
    return out


class Increments:
    """What the smoothed increments say of the densities, summed by variable, class, component and cause."""

    def __init__(self, problem: Problem, now: list[Densities]):
        self.problem, self.now = problem, now
        self.total = [np.zeros_like(d.density) for d in now]
        """Squares that each cause explains, (3, h, 2)."""
        self.known = [np.zeros_like(d.density) for d in now]
        """``sum tr M - T``."""

    def add(self, part: Part, found: Marginals) -> None:
        """The increments of a part of the log, and that to the part that follows."""
        for k, now in enumerate(self.now):
            square, told = _shares(part.problem, part.values, found, k)
            label = now.label[part.start : part.start + len(square)]
            for c in range(len(CLASSES)):
                self.total[k][c] += square[label == c].sum(axis=0)
                self.known[k][c] += told[label == c].sum(axis=0)

    def learned(self, classes: tuple[int, ...] = tuple(range(len(CLASSES)))) -> list[Densities]:
        """One round: densities of some classes at which the marginal likelihood of these states is stationary."""
        out = []
        for k, variable in enumerate(self.problem.tie.variables):
            old, known, total = self.now[k], self.known[k].copy(), self.total[k].copy()
            count = np.maximum(known.sum(axis=-1), 0.0)
            for axes in np.split(np.arange(variable.half), variable.half // 3 or 1):
                # A machine shakes about all axes alike: what folds into slow motion on one of them, others show.
                known[:, axes, 1] = known[:, axes, 1].sum(axis=1, keepdims=True)
                total[:, axes, 1] = total[:, axes, 1].sum(axis=1, keepdims=True)
                for c in range(len(CLASSES)):
                    # What a component alone does not tell it shares with the other two.
                    few = axes[count[c, axes] < ENOUGH]
                    known[c, few], total[c, few] = known[c, axes].sum(axis=0), total[c, axes].sum(axis=0)
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.clip(np.where(known > 0, total / known, 1.0), 1 / FASTEST, FASTEST)
            # A cause that is not there falls by the same share in every round: two rounds at once.
            factor[..., 1] = np.where(factor[..., 1] < 0.5, factor[..., 1] ** 2, factor[..., 1])
            density = old.density * np.where(known.sum(axis=-1)[..., None] < ENOUGH, 1.0, factor)
            floor = LEAST_SHARE * motion.density_of(variable.kind, variable.motion)[:, 0]
            density[..., 0] = np.maximum(density[..., 0], floor)
            told = np.isin(np.arange(len(CLASSES)), classes)[:, None]
            out.append(
                Densities(
                    old.label, np.where(told[..., None], density, old.density), np.where(told, count, 0.0)
                )
            )
        return out


def moved_by(old: list[Densities], new: list[Densities]) -> float:
    """Largest ratio between two rounds of what a measured density adds to a position, at least 1."""
    worst = 1.0
    for a, b in zip(old, new, strict=True):
        use = b.measured >= ENOUGH
        if np.any(use):
            worst = max(worst, float(np.exp(np.abs(np.log(b.spread()[use] / a.spread()[use])).max())))
    return worst


def described(problem: Problem, densities: list[Densities]) -> dict:
    """For solution.json: by body and class its seconds, densities, and how many increments told them."""
    out: dict = {}
    for variable, found in zip(problem.tie.variables, densities, strict=True):
        parts = {"translation": slice(0, 3), "rotation": slice(3, 6)}
        if variable.kind == "joint":
            parts = {"rotation": slice(0, 1)}
        files = {"translation": variable.motion[0], "rotation": variable.motion[1]}
        entry: dict = {"configured": {p: float(files[p]) for p in parts}}
        for c, name in enumerate(CLASSES):
            here = found.label == c
            if not np.any(here):
                continue
            entry[name] = {"seconds": round(float(problem.dt_s[here].sum()), 2)} | {
                p: {
                    "density": [float(f"{v:.4g}") for v in found.density[c, at, 0]],
                    "shake": [float(f"{v:.4g}") for v in found.density[c, at, 1]],
                    "measured": [round(float(n), 1) for n in found.measured[c, at]],
                    "learned": bool(found.measured[c, at].sum() >= ENOUGH),
                }
                for p, at in parts.items()
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


def _shares(problem: Problem, values: Values, found: Marginals, k: int):
    """What each density explains of the motion residuals of a variable, and how much of that was measured.

    Returns two (E - 1, h, 2) arrays: squares, and expected squares less their posterior variances.
    """
    c, at = problem.place(k)
    e, A, B = motion_residual(problem, values, k)
    assert A is not None and B is not None
    h = e.shape[1] // 2
    Z_1, Z_2 = found.Z[c][:-1, at, at], found.Z[c][1:, at, at]
    Z_12 = -(found.G[c] @ found.Z[c][1:])[:, at, at]
    AZ, BZ = A @ Z_1 + B @ np.swapaxes(Z_12, -1, -2), B @ Z_2 + A @ Z_12
    P = np.einsum("nik,njk->nij", AZ, A) + np.einsum("nik,njk->nij", BZ, B)
    first, second = np.arange(h), np.arange(h, 2 * h)
    P_11, P_12, P_22 = P[:, first, first], P[:, first, second], P[:, second, second]
    q, dt = problem.densities[k], problem.dt_s
    W, v = motion.whitening(dt, q), q[..., 1] * dt[:, None]
    w00, w10 = W[..., 0], W[..., 1]
    # The whitened covariance of each cause: M = W Q W', with both together the unit matrix.
    shake = np.stack([w00**2 * v, w00 * w10 * v, w10**2 * v])
    share = np.stack([np.stack([1 - shake[0], -shake[1], 1 - shake[2]]), shake])  # (cause, entry, n, h)
    e_1, e_2 = e[:, :h], e[:, h:]

    def product(M, a, b, d):
        return M[:, 0] * a + 2 * M[:, 1] * b + M[:, 2] * d

    square = product(share, e_1**2, e_1 * e_2, e_2**2)
    told = share[:, 0] + share[:, 2] - product(share, P_11, P_12, P_22)
    return np.moveaxis(square, 0, -1), np.moveaxis(told, 0, -1)


def parked(problem: Problem, k: int, window_s: float = WINDOW_S):
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
                          problem.epochs.time_s[epoch], window_s)  # fmt: skip
            still[epoch] &= here
            seen[epoch] = True
    for readings in problem.sensors:
        if readings.variable == k:
            sigma = np.full((len(readings.raw), 1), max(readings.sensor.noise, 1e-12))
            here = _quiet(readings.raw[:, None], sigma, problem.epochs.time_s[readings.epoch], window_s)
            np.logical_and.at(still, readings.epoch, here)
            seen[readings.epoch] = True
    at = np.flatnonzero(seen)
    if len(at) < 2:
        return np.zeros(E - 1, dtype=bool)
    # An interval is parked where the last sighting before it and the first one after it are.
    before = at[np.clip(np.searchsorted(at, np.arange(E - 1), side="right") - 1, 0, None)]
    after = at[np.clip(np.searchsorted(at, np.arange(1, E)), None, len(at) - 1)]
    near = problem.epochs.time_s[after] - problem.epochs.time_s[before] < window_s
    return still[before] & still[after] & near


def _quiet(values, sigma, time_s, window_s):
    """(n,) bool: the range of every column over the window around each row is that of noise."""
    if len(values) < 4:
        return np.zeros(len(values), dtype=bool)
    width = max(3, round(window_s / max(float(np.median(np.diff(time_s))), 1e-3)) | 1)
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
