"""Surveyed points that a standing machine was on, as observations of the statics that a log has left open.

At the epoch of a shot the pose of some body is known to ``xi = own + M dz``: its own error there, and what the statics'
unknowns make of it (`estimation.marginals.body_track`). What a shot should be is zero, ``r(T exp(xi), p + d, z + dz)``,
with the error ``d`` of a known point where several shots are of one. Unknown are ``dz``, with the covariance that the
log left, one own error per epoch, and ``d``. So what a benchmark or a mount is uncertain by is the same in all shots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
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
STEPS, SETTLED = 10, 1e-9

Residual = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
"""``r(T_world_body, p_world, z)`` (k,), and its Jacobians by ``xi`` (k, 6), by ``p`` (k, 3) and by ``z`` (k, p)."""


@dataclass(frozen=True, eq=False)
class HeldPoint:
    """A shot, and the pose of the body that it is of."""

    name: str
    p_world: np.ndarray
    """(3,) m."""
    sigma_m: float
    """Of each coordinate, of this shot alone."""
    epoch: int
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
    normalised: float
    """The same in its sigmas; near 1."""
    wrong: bool


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
    return HeldPoint(name, p_world, sigma_m, epoch, *at, residual, known)


def with_points(
    whole: Adjusted, held: Sequence[HeldPoint], known_sigma_m: Sequence[float] = ()
) -> tuple[Adjusted, list[PointFit]]:
    """The adjustment with shots, by Gauss-Newton about what the log alone says; and the shots' fits.

    With ``S`` the covariance of all ``r`` before the shots, what shot k is off without it is
    ``(S^-1)_kk^-1 (S^-1 r)_k``, and ``(S^-1)_kk^-1`` its covariance.

    Returns
    -------
    whole : Adjusted
        The same with statics, and their covariance, as the shots moved them. States are those of before.
    fits : list of PointFit
    """
    z_0 = whole.optimum.values.z
    p = len(z_0)
    epochs = sorted({h.epoch for h in held})
    prior = np.zeros((p + 6 * len(epochs) + 3 * len(known_sigma_m),) * 2)
    prior[:p, :p] = whole.found.P_zz
    places = []
    for h in held:
        at = p + 6 * epochs.index(h.epoch)
        prior[at : at + 6, at : at + 6] = h.own
        places.append(slice(at, at + 6))
    first = p + 6 * len(epochs)
    prior[first:, first:] = np.diag(np.repeat(np.square(known_sigma_m), 3))
    y = np.zeros(len(prior))
    for _ in range(STEPS):
        r, J, noise, rows = _linearised(held, places, first, z_0, y)
        r = r - J @ y  # as it is at y = 0, to first order
        S_inverse = np.linalg.inv(J @ prior @ J.T + noise)
        K = prior @ J.T @ S_inverse
        before, y = y, -K @ r
        if np.abs(y - before).max() < SETTLED:
            break
    P = prior - K @ J @ prior
    fits = []
    for h, at in zip(held, rows, strict=True):
        covariance = np.linalg.inv(S_inverse[at, at])
        off = covariance @ (S_inverse @ r)[at]
        square, k = float(off @ np.linalg.solve(covariance, off)), len(off)
        limit = float(chi2.isf(ALARM, k))
        fits.append(PointFit(h.name, float(np.linalg.norm(off)), float(np.sqrt(square / k)), square > limit))
    values = replace(whole.optimum.values, z=z_0 + y[:p])
    told = replace(
        whole,
        optimum=replace(whole.optimum, values=values),
        found=replace(whole.found, P_zz=0.5 * (P + P.T)[:p, :p]),
    )
    return told, fits


def _linearised(held: Sequence[HeldPoint], places: list[slice], first: int, z_0: np.ndarray, y: np.ndarray):
    """Residuals, Jacobian, noise of all shots together, and the rows of each."""
    parts, rows, start = [], [], 0
    dz = y[: len(z_0)]
    for h, at in zip(held, places, strict=True):
        d = slice(first + 3 * h.known, first + 3 * h.known + 3)
        p_world = h.p_world + (y[d] if h.known >= 0 else 0.0)
        T = h.T_world_body @ se3.exp(y[at] + h.M @ dz)
        r, by_pose, by_point, by_z = h.residual(T, p_world, z_0 + dz)
        J = np.zeros((len(r), len(y)))
        J[:, : len(z_0)] = by_pose @ h.M + by_z
        J[:, at] = by_pose
        if h.known >= 0:
            J[:, d] = by_point
        parts.append((r, J, h.sigma_m**2 * by_point @ by_point.T))
        rows.append(slice(start, start + len(r)))
        start += len(r)
    noise = np.zeros((start, start))
    for at, (_, _, own) in zip(rows, parts, strict=True):
        noise[at, at] = own
    return np.concatenate([r for r, _, _ in parts]), np.concatenate([J for _, J, _ in parts]), noise, rows
