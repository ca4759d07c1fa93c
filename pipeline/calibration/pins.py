"""Surveyed pins: ends of a joint's pin, shot with the total station while the machine stands before its cameras.

A shot lies on the joint's axis, wherever along it. With the pose of the body that carries the axis at that moment,

    r = [x, y] of  T_parent_axis^-1 T_world_parent(t)^-1 p  =  0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.calibration.adjusted import Adjusted
from pipeline.calibration.held_points import HeldPoint, PointFits, Residual, held_point, with_points
from pipeline.errors import CalibrationError
from pipeline.geometry import se3, so3
from pipeline.network import frames as fr

LEAST_APART_M = 0.25
"""Ends of a pin nearer than this leave its direction open to half a degree with shots of 2 mm."""
OPEN_RAD = 0.05
"""A direction that is open by more is not told by pictures."""


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


def with_pins(
    whole: Adjusted, parents: dict[str, str], shots: Sequence[PinShot]
) -> tuple[Adjusted, PointFits]:
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
    fits : PointFits

    Raises
    ------
    CalibrationError
        A shot has no pose of its body, the machine moved, ends lie too near, or a shot contradicts everything else.
    """
    held = [
        held_point(
            whole,
            fr.body_frame(parents[shot.joint]),
            shot.name,
            shot.time_ns,
            shot.p_world,
            shot.sigma_m,
            _off_axis(whole, shot.joint),
        )
        for shot in shots
    ]
    for joint in parents:
        of_joint = [h for h, shot in zip(held, shots, strict=True) if shot.joint == joint]
        _refuse_short_pin(whole, joint, of_joint)
    told, fits = with_points(whole, held)
    off = fits.culprit
    if off is not None:
        raise CalibrationError(
            f"shot '{off.name}' of a pin lies {1000 * off.off_m:.0f} mm ({off.normalised:.0f} sigma) off the "
            "axis that everything else tells; check its coordinates and its time; nothing was written"
        )
    if fits.wrong:
        raise CalibrationError(
            f"the shots of pins do not go with each other and the pictures ({fits.normalised:.0f} sigma): check their "
            "coordinates, their times, which pin they are of, and the benchmarks; nothing was written"
        )
    return told, fits


def axis_static(joint: str) -> str:
    """Name of a joint's axis among the statics."""
    return f"joint {joint} axis"


def _off_axis(whole: Adjusted, joint: str) -> Residual:
    """Residual of a shot of a joint's pin."""
    statics, k = whole.problem.statics, whole.index(axis_static(joint))

    def residual(T_world_parent: np.ndarray, p_world: np.ndarray, z: np.ndarray):
        T_axis = statics.value(k, z)
        p_parent = se3.transform(se3.inverse(T_world_parent), p_world)
        p_axis = se3.transform(se3.inverse(T_axis), p_parent)
        R = T_axis[:3, :3].T
        by_z = np.zeros((3, len(z)))
        by_z[:, statics.columns[k]] = -np.hstack([np.eye(3), -so3.hat(p_axis)]) @ statics.sensitivity(k, z)
        by_pose = -R @ np.hstack([np.eye(3), -so3.hat(p_parent)])
        by_point = R @ T_world_parent[:3, :3].T
        return p_axis[:2], by_pose[:2], by_point[:2], by_z[:2]

    return residual


def _refuse_short_pin(whole: Adjusted, joint: str, held: Sequence[HeldPoint]) -> None:
    """One end tells where a pin is, two tell its direction."""
    p = np.array([se3.transform(se3.inverse(h.T_world_body), h.p_world) for h in held])
    if np.sqrt(np.diagonal(whole.covariance(axis_static(joint))))[3:5].max() <= OPEN_RAD:
        return
    if len(p) < 2 or np.linalg.norm(p[:, None] - p[None], axis=-1).max() < LEAST_APART_M:
        raise CalibrationError(
            f"the shots of the pin of '{joint}' lie within {LEAST_APART_M:g} m and leave its direction open: shoot "
            "both of its ends, or hold a marker to what turns about it; nothing was written"
        )
