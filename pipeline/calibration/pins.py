"""Surveyed pins: ends of a joint's pin, shot with the total station while the machine stands before its cameras.

A shot lies on the joint's axis, wherever along it. With the pose of the body that carries the axis at that moment,

    r = [x, y] of  T_parent_axis^-1 T_world_parent(t)^-1 p  =  0

Unknown are the statics, as everything else in the log left them, and one own error of the parent's pose per shot; so
what a benchmark or a mount is uncertain by reaches both ends of a pin alike. Shots that come from one stop share their
epoch, and with it its own error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibration.adjusted import Adjusted
from pipeline.errors import CalibrationError
from pipeline.estimation.marginals import body_track
from pipeline.geometry import se3, so3
from pipeline.network import frames as fr

HOLD_S = 2.0
"""A pin is shot while the machine stands for this long before and after: surveyors' clocks have whole seconds."""
STILL_M = 0.01
LEAST_APART_M = 0.25
"""Ends of a pin nearer than this leave its direction open to half a degree with shots of 2 mm."""
WRONG = 13.8
"""0.1 % of a chi-square of two."""
STEPS, SETTLED = 10, 1e-9


@dataclass(frozen=True)
class PinShot:
    """One shot of a pin's end."""

    name: str
    joint: str
    """The body that turns about the pin."""
    time_ns: int
    p_world: np.ndarray
    """(3,) m."""
    sigma_m: float
    """Of each coordinate."""


@dataclass(frozen=True, eq=False)
class _Sighted:
    """A shot and the pose of the body that carries the pin."""

    shot: PinShot
    epoch: int
    T_world_parent: np.ndarray
    own: np.ndarray
    """(6, 6)."""
    M: np.ndarray
    """(6, p) error of that pose by the statics' unknowns."""


@dataclass(frozen=True, eq=False)
class PinFit:
    """A shot against what all others and the pictures say."""

    shot: PinShot
    off_m: float
    """Distance from the axis that is told without it."""
    normalised: float
    """The same in its sigmas; near 1."""


def with_pins(
    whole: Adjusted, parents: dict[str, str], shots: Sequence[PinShot]
) -> tuple[Adjusted, list[PinFit]]:
    """The adjustment with shots of pins.

    Parameters
    ----------
    whole : Adjusted
        Of the log, with the axes of all joints that were shot among its statics.
    parents : dict of str to str
        Body that carries the axis, by joint.
    shots : sequence of PinShot
        In any order.

    Returns
    -------
    whole : Adjusted
        The same with statics, and their covariance, as the shots moved them. States are those of before.
    fits : list of PinFit

    Raises
    ------
    CalibrationError
        A shot has no pose of its body, the machine moved, ends lie too near, or a shot contradicts everything else.
    """
    sighted = [_sighted(whole, parents[shot.joint], shot) for shot in shots]
    _refuse_short_pins(whole, parents, sighted)
    z, P, fits = _solved(whole, sighted)
    worst = max(fits, key=lambda fit: fit.normalised)
    if 2 * worst.normalised**2 > WRONG:
        raise CalibrationError(
            f"shot '{worst.shot.name}' of the pin of '{worst.shot.joint}' lies {1000 * worst.off_m:.0f} mm "
            f"({worst.normalised:.0f} sigma) off the axis that everything else tells; check its coordinates and its "
            "time; nothing was written"
        )
    values = replace(whole.optimum.values, z=z)
    return replace(
        whole, optimum=replace(whole.optimum, values=values), found=replace(whole.found, P_zz=P)
    ), fits


def axis_static(joint: str) -> str:
    """Name of a joint's axis among the statics."""
    return f"joint {joint} axis"


def _sighted(whole: Adjusted, parent: str, shot: PinShot) -> _Sighted:
    problem = whole.problem
    frame = fr.body_frame(parent)
    if frame not in problem.tie.frames:
        raise CalibrationError(
            f"pin of '{shot.joint}': '{parent}', which carries it, is not tied to anything that was seen"
        )
    track = body_track(problem, whole.optimum.values, whole.found, frame, parent)
    seconds = (problem.epochs.time_ns - shot.time_ns) / 1e9
    near = np.flatnonzero(np.abs(seconds) <= HOLD_S)
    if not len(near):
        raise CalibrationError(
            f"shot '{shot.name}': no picture of the log within {HOLD_S:g} s of it shows '{parent}'; check its time and "
            "its zone"
        )
    epoch = int(near[np.argmin(np.abs(seconds[near]))])
    p = se3.transform(se3.inverse(track.T_world_body[near]), shot.p_world)
    moved = float(np.linalg.norm(np.ptp(p, axis=0)))
    if moved > STILL_M:
        raise CalibrationError(
            f"shot '{shot.name}': '{parent}' moved by {1000 * moved:.0f} mm within {HOLD_S:g} s of it; the machine "
            "has to stand still while its pin is shot"
        )
    return _Sighted(shot, epoch, track.T_world_body[epoch], track.own[epoch], track.M[epoch])


def _refuse_short_pins(whole: Adjusted, parents: dict[str, str], sighted: list[_Sighted]) -> None:
    """One end tells where a pin is, two tell its direction."""
    for joint in parents:
        p = np.array(
            [
                se3.transform(se3.inverse(s.T_world_parent), s.shot.p_world)
                for s in sighted
                if s.shot.joint == joint
            ]
        )
        sigma = np.sqrt(np.diagonal(whole.covariance(axis_static(joint))))
        if sigma[3:5].max() > 0.05 and (
            len(p) < 2 or np.linalg.norm(p[:, None] - p[None], axis=-1).max() < LEAST_APART_M
        ):
            raise CalibrationError(
                f"the shots of the pin of '{joint}' lie within {LEAST_APART_M:g} m and leave its direction open: shoot "
                "both of its ends, or hold a marker to what turns about it; nothing was written"
            )


def _off(whole: Adjusted, s: _Sighted, z: np.ndarray, own: np.ndarray):
    """(2,) of a shot off its axis, and its Jacobians by the statics (2, p) and by the parent's own error (2, 6)."""
    statics, k = whole.problem.statics, whole.index(axis_static(s.shot.joint))
    T_axis = statics.value(k, z)
    xi = own + s.M @ (z - whole.optimum.values.z)
    p_parent = se3.transform(se3.inverse(s.T_world_parent @ se3.exp(xi)), s.shot.p_world)
    p_axis = se3.transform(se3.inverse(T_axis), p_parent)
    by_axis = -np.hstack([np.eye(3), -so3.hat(p_axis)])
    by_pose = -T_axis[:3, :3].T @ np.hstack([np.eye(3), -so3.hat(p_parent)])
    by_z = by_pose @ s.M
    by_z[:, statics.columns[k]] += by_axis @ statics.sensitivity(k, z)
    return p_axis[:2], by_z[:2], by_pose[:2]


def _system(whole: Adjusted, sighted: list[_Sighted], z: np.ndarray, own: np.ndarray):
    """Residuals (2n,), Jacobian (2n, p + 6e), prior covariance, noise: of all shots together."""
    epochs = sorted({s.epoch for s in sighted})
    p = len(z)
    prior = np.zeros((p + 6 * len(epochs),) * 2)
    prior[:p, :p] = whole.found.P_zz
    r, J = np.zeros(2 * len(sighted)), np.zeros((2 * len(sighted), len(prior)))
    for i, s in enumerate(sighted):
        at = slice(p + 6 * epochs.index(s.epoch), p + 6 * epochs.index(s.epoch) + 6)
        prior[at, at] = s.own
        rows = slice(2 * i, 2 * i + 2)
        r[rows], J[rows, :p], J[rows, at] = _off(whole, s, z, own[at.start - p : at.stop - p])
    noise = np.diag(np.repeat([s.shot.sigma_m**2 for s in sighted], 2))
    return r, J, prior, noise


def _solved(whole: Adjusted, sighted: list[_Sighted]) -> tuple[np.ndarray, np.ndarray, list[PinFit]]:
    """Statics and their covariance with the shots, by Gauss-Newton about what the log alone says; and the shots' fits.

    With ``S`` the covariance of all ``r`` before the shots, what shot k is off the axis that is told without it is
    ``(S^-1)_kk^-1 (S^-1 r)_k``, and ``(S^-1)_kk^-1`` its covariance.
    """
    z_0 = whole.optimum.values.z
    p = len(z_0)
    y = np.zeros(p + 6 * len({s.epoch for s in sighted}))
    for _ in range(STEPS):
        r, J, prior, noise = _system(whole, sighted, z_0 + y[:p], y[p:])
        r = r - J @ y  # as it is at y = 0, to first order
        S_inverse = np.linalg.inv(J @ prior @ J.T + noise)
        K = prior @ J.T @ S_inverse
        before, y = y, -K @ r
        if np.abs(y - before).max() < SETTLED:
            break
    P = prior - K @ J @ prior
    fits = []
    for k, s in enumerate(sighted):
        at = slice(2 * k, 2 * k + 2)
        covariance = np.linalg.inv(S_inverse[at, at])
        off = covariance @ (S_inverse @ r)[at]
        fits.append(
            PinFit(
                s.shot, float(np.linalg.norm(off)), float(np.sqrt(off @ np.linalg.solve(covariance, off) / 2))
            )
        )
    return z_0 + y[:p], 0.5 * (P + P.T)[:p, :p], fits
