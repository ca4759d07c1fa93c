"""Surveyed points that a standing machine was on, as observations of the statics that a log has left open.

While the machine stands the pose of some body is known to ``xi = own + M dz``: its own error there, and what the
statics' unknowns make of it (`estimation.marginals.body_track`). What a shot should be is zero,
``r(T exp(xi), p + d, z + dz)``, with the error ``d`` of a known point where several shots are of one. Unknown are
``dz``, with the covariance that the log left, one own error per stand, and ``d``. So what a benchmark or a mount is
uncertain by is the same in all shots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from pipeline.calibration.adjusted import Adjusted
from pipeline.errors import CalibrationError
from pipeline.estimation.marginals import body_track
from pipeline.geometry import se3, so3

HOLD_S = 2.0
"""A point is shot while the machine stands for this long before and after: surveyors' clocks have whole seconds."""
STILL_M, STILL_SIGMAS = 0.01, 6.0
"""What moved by more than the first and so many of its own sigmas did not stand: the range of twenty draws is 3.7."""
ALARM = 1e-3
"""Chance of a shot without a fault to be called wrong."""
STEPS, SETTLED = 30, 1e-8

Residual = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
"""``r(T_world_body, p_world, z)`` (k,), and its Jacobians by ``xi`` (k, 6), by ``p`` (k, 3) and by ``z`` (k, p)."""


@dataclass(frozen=True, eq=False)
class HeldPoint:
    """A shot, and the pose of the body's frame that it is of."""

    name: str
    p_world: np.ndarray
    """(3,) m."""
    sigma_m: float
    """Of each coordinate, of this shot alone."""
    frame: str
    time_ns: int
    T_world_body: np.ndarray
    own: np.ndarray
    """(6, 6)."""
    M: np.ndarray
    """(6, p)."""
    residual: Residual
    known: int = -1
    """Index of the known point that it is of; -1 for a shot of its own."""


@dataclass(frozen=True, eq=False)
class PointFit:
    """A shot against what all others and the pictures say."""

    name: str
    off_m: float
    """Distance from where it should be without it."""
    sigma_m: float
    """Of that distance, in its worst direction: large where nothing else tells where it should be."""
    normalised: float
    """The same in its sigmas; near 1."""


@dataclass(frozen=True, eq=False)
class PointFits:
    """All shots, by themselves and together."""

    each: tuple[PointFit, ...]
    normalised: float
    """Of all together, in the sigmas of what was known before them; near 1."""
    culprit: PointFit | None
    """The only shot without which the others go together."""
    wrong: bool
    """They contradict what was known by more than chance."""


def held_point(
    whole: Adjusted,
    frame: str,
    name: str,
    time_ns: int,
    p_world: np.ndarray,
    sigma_m: float,
    residual: Residual,
    known: int = -1,
) -> HeldPoint:
    """A shot of a point of a frame.

    Raises
    ------
    CalibrationError
        The frame is tied to nothing, no picture shows it then, or it moved.
    """
    problem, what = whole.problem, frame.removeprefix("body ")
    if frame not in problem.tie.frames:
        raise CalibrationError(f"shot '{name}': '{what}' is not tied to anything that was seen")
    track = body_track(problem, whole.optimum.values, whole.found, frame, what)
    seconds = (problem.epochs.time_ns - time_ns) / 1e9
    near = np.flatnonzero(np.abs(seconds) <= HOLD_S)
    if not len(near):
        raise CalibrationError(
            f"shot '{name}': no picture of the log within {HOLD_S:g} s of it shows '{what}'; check its time and "
            "its zone"
        )
    if np.ptp(seconds[near]) < HOLD_S:
        raise CalibrationError(
            f"shot '{name}': pictures of '{what}' span {np.ptp(seconds[near]):.1f} s of the {2 * HOLD_S:g} s about it, "
            "too few to tell that it stood; shoot while the machine stands before the cameras"
        )
    epoch = int(near[np.argmin(np.abs(seconds[near]))])
    p = se3.transform(se3.inverse(track.T_world_body[near]), p_world)
    moved = float(np.linalg.norm(np.ptp(p, axis=0)))
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -so3.hat(p)], axis=-1)
    noise = np.trace(J @ track.own[near] @ np.swapaxes(J, -1, -2), axis1=1, axis2=2)
    if moved > STILL_M + STILL_SIGMAS * np.sqrt(np.median(noise)):
        raise CalibrationError(
            f"shot '{name}': '{what}' moved by {1000 * moved:.0f} mm within {HOLD_S:g} s of it; the machine has to "
            "stand still then"
        )
    at = track.T_world_body[epoch], track.own[epoch], track.M[epoch]
    return HeldPoint(name, p_world, sigma_m, frame, time_ns, *at, residual, known)


def with_points(
    whole: Adjusted, held: Sequence[HeldPoint], known_sigma_m: Sequence[float] = ()
) -> tuple[Adjusted, PointFits]:
    """The adjustment with shots, by Gauss-Newton about what the log alone says; and the shots' fits.

    With ``S`` the covariance of all ``r`` before the shots, what shot k is off without it is
    ``(S^-1)_kk^-1 (S^-1 r)_k``, and ``(S^-1)_kk^-1`` its covariance; all together ``r' S^-1 r`` is a chi-square.
    Which shot is wrong is told by leaving out each in turn: a wrong one turns an axis so far that what is linear about
    that answer says too little of the others.

    Returns
    -------
    whole : Adjusted
        The same with statics, and their covariance, as the shots moved them. States are those of before.
    fits : PointFits

    Raises
    ------
    CalibrationError
        No answer was found.
    """
    prior = _Prior.of(whole, held, known_sigma_m)
    y, P, each, square = prior.fitted(range(len(prior.held)))
    size = sum(len(fit.off) for fit in each)
    wrong = square > chi2.isf(ALARM, size)
    wrong |= any(chi2.sf(fit.square, len(fit.off)) < ALARM / len(each) for fit in each)
    culprit = prior.culprit() if wrong else None
    fits = PointFits(
        tuple(fit.published() for fit in each),
        float(np.sqrt(square / size)),
        None if culprit is None else culprit.published(),
        bool(wrong),
    )
    p = len(prior.z_0)
    values = replace(whole.optimum.values, z=prior.z_0 + y[:p])
    told = replace(
        whole,
        optimum=replace(whole.optimum, values=values),
        found=replace(whole.found, P_zz=0.5 * (P + P.T)[:p, :p]),
    )
    return told, fits


@dataclass(frozen=True, eq=False)
class _Off:
    """A shot against what is told without it."""

    name: str
    off: np.ndarray
    """(k,) m."""
    covariance: np.ndarray

    @property
    def square(self) -> float:
        return float(self.off @ np.linalg.solve(self.covariance, self.off))

    def published(self) -> PointFit:
        worst_m = float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))
        ratio = float(np.sqrt(self.square / len(self.off)))
        return PointFit(self.name, float(np.linalg.norm(self.off)), worst_m, ratio)


@dataclass(frozen=True, eq=False)
class _Prior:
    """Shots, and what is known before them of the unknowns ``y``, all 0: ``dz``, own errors of stands, known points."""

    z_0: np.ndarray
    held: list[HeldPoint]
    places: list[slice]
    """Of each shot's own error among ``y``."""
    first: int
    """Of the known points among ``y``."""
    covariance: np.ndarray

    @classmethod
    def of(cls, whole: Adjusted, shots: Sequence[HeldPoint], known_sigma_m: Sequence[float]) -> _Prior:
        z_0 = whole.optimum.values.z
        p = len(z_0)
        held, stands = _by_stand(shots)
        first = p + 6 * (max(stands, default=-1) + 1)
        covariance = np.zeros((first + 3 * len(known_sigma_m),) * 2)
        covariance[:p, :p] = whole.found.P_zz
        places = [slice(p + 6 * stand, p + 6 * stand + 6) for stand in stands]
        for h, at in zip(held, places, strict=True):
            covariance[at, at] = h.own
        covariance[first:, first:] = np.diag(np.repeat(np.square(known_sigma_m), 3))
        return cls(z_0, held, places, first, covariance)

    def fitted(self, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray, list[_Off], float]:
        """``y`` by some shots, its covariance, each of them against the others, and the sum of squares of all."""
        y = np.zeros(len(self.covariance))
        for _ in range(STEPS):
            parts = [self.linearised(k, y) for k in rows]
            J = np.concatenate([J for _, J, _ in parts])
            r = np.concatenate([r for r, _, _ in parts]) - J @ y  # as it is at y = 0, to first order
            noise = block_diag(*(noise for _, _, noise in parts))
            S_inverse = np.linalg.inv(J @ self.covariance @ J.T + noise)
            K = self.covariance @ J.T @ S_inverse
            before, y = y, -K @ r
            if np.abs(y - before).max() < SETTLED:
                break
        else:
            raise CalibrationError(
                "the shots lie so far from where machine.toml and site.toml have them that no answer was found; check "
                "their coordinates, their times and the grid; nothing was written"
            )
        each, start = [], 0
        for k, (part, _, _) in zip(rows, parts, strict=True):
            at = slice(start, start + len(part))
            covariance = np.linalg.inv(S_inverse[at, at])
            each.append(_Off(self.held[k].name, covariance @ (S_inverse @ r)[at], covariance))
            start = at.stop
        return y, self.covariance - K @ J @ self.covariance, each, float(r @ S_inverse @ r)

    def culprit(self) -> _Off | None:
        """The only shot without which the others go together; none where there is no such one, or several."""
        cured = []
        rows = range(len(self.held)) if len(self.held) > 1 else ()
        for k in rows:
            others = [j for j in rows if j != k]
            try:
                y, P, each, square = self.fitted(others)
            except CalibrationError:  # the wrong one is among them
                continue
            if square <= chi2.isf(ALARM, sum(len(fit.off) for fit in each)):
                r, J, noise = self.linearised(k, y)
                cured.append(_Off(self.held[k].name, r, J @ P @ J.T + noise))
        return cured[0] if len(cured) == 1 else None

    def linearised(self, k: int, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual of a shot, its Jacobian by ``y``, and its noise."""
        h, at, dz = self.held[k], self.places[k], y[: len(self.z_0)]
        d = slice(self.first + 3 * h.known, self.first + 3 * h.known + 3)
        p_world = h.p_world + (y[d] if h.known >= 0 else 0.0)
        T = h.T_world_body @ se3.exp(y[at] + h.M @ dz)
        r, by_pose, by_point, by_z = h.residual(T, p_world, self.z_0 + dz)
        J = np.zeros((len(r), len(y)))
        J[:, : len(self.z_0)] = by_pose @ h.M + by_z
        J[:, at] = by_pose
        if h.known >= 0:
            J[:, d] = by_point
        return r, J, h.sigma_m**2 * by_point @ by_point.T


def _by_stand(held: Sequence[HeldPoint]) -> tuple[list[HeldPoint], list[int]]:
    """Shots with the pose of their stand, and its number.

    The machine stood for `HOLD_S` about each, so shots no further apart are of one pose, and share its own error. Taken
    at pictures of their own, as if errors of those were independent, nine touches in one stand gave three quarters of
    the sigma that the phase of a belt has: they are correlated by 0.9 at 0.4 s, and by 0.2 at two seconds.
    """
    first: list[HeldPoint] = []
    posed, numbers = [], []
    for h in sorted(held, key=lambda h: h.time_ns):
        near = [
            k
            for k, other in enumerate(first)
            if other.frame == h.frame and h.time_ns - other.time_ns <= HOLD_S * 1e9
        ]
        if not near:
            near = [len(first)]
            first.append(h)
        stand = first[near[-1]]
        posed.append(replace(h, T_world_body=stand.T_world_body, own=stand.own, M=stand.M))
        numbers.append(near[-1])
    return posed, numbers
