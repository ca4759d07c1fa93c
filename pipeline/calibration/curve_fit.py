"""What is written of an adjusted bucket: a curve, a tool, and an exact linkage, with nothing free twice.

The adjustment knows the angle at every reading with a covariance to which bars, pin and curve all contribute; a file
has one covariance for the curve and another for the tool. So that these two say it all:

* the direction from the pin to the middle of the edge is held in the bucket's frame, at the angle that the file had:
  whatever is not known of an angle is the curve's;
* the bars stay as the file has them, exact. The curve is fitted to the *angle*, through these bars, by a polynomial
  with as many coefficients as that needs (at most five), and its covariance is that of the angle, carried through the
  same fit: over the calibrated stroke the file gives the adjusted angle and its sigma back.

The fit's own misfit and what it does to sigma are measured on the spot (`Written`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.touches import TOOL, Adjusted, Rig, angle_of, powers_of_raw
from pipeline.geometry import linkage, se3, so3

MOST_COEFFICIENTS = 5
MISFIT_RAD = np.deg2rad(0.003)
SIGMA_OFF = 0.02
"""A polynomial is good enough when it is off by less than this, and its sigma by less than this share."""
NODES = 41
BEYOND = 0.08
"""Share of the stroke by which the curve may be used beyond the touches on either side; it is flagged there."""


@dataclass(frozen=True, eq=False)
class Written:
    """The values of the new file."""

    coefficients: np.ndarray
    """(n,) ascending powers of the raw reading."""
    covariance: np.ndarray
    """(n, n)."""
    raw_range: tuple[float, float]
    """Readings that are used at all."""
    stroke: tuple[float, float]
    """Readings of the touches: beyond, the curve is extrapolated."""
    T_bucket_tool: np.ndarray
    """(4, 4)."""
    tool: np.ndarray
    """(6, 6) covariance, right perturbation; nothing across the line from the pin."""
    misfit_rad: float
    """Largest difference between the adjusted angle and the file's over the stroke."""
    sigma_off: float
    """Largest relative difference between the two sigmas."""


@dataclass(frozen=True, eq=False)
class Direction:
    """Where the edge points from the pin: the angle of the bucket and of the tool in it, which no choice moves."""

    angle_rad: np.ndarray
    """(n,) in the stick's plane, from the axis frame's x."""
    J: np.ndarray
    """(n, p)."""
    sigma_rad: np.ndarray
    """(n,)."""


def direction(found: Adjusted, raw: np.ndarray) -> Direction:
    """Direction of the edge at readings (n,), nan beyond the reach of the bars."""
    angle, J = found.angle(np.asarray(raw, float))
    J = J.copy()
    azimuth, J_azimuth = azimuth_of(found.T_bucket_tool())
    J[:, TOOL] += J_azimuth @ se3.Jr(found.value[TOOL])
    return Direction(angle + azimuth, J, np.sqrt(np.einsum("ni,ij,nj->n", J, found.covariance, J)))


def azimuth_of(T_bucket_tool: np.ndarray) -> tuple[float, np.ndarray]:
    """Direction of the middle of the edge about the bucket's z, radians, and (6,) its right Jacobian."""
    x, y = T_bucket_tool[:2, 3]
    J_azimuth_p = np.array([-y, x, 0.0]) / (x * x + y * y)
    return float(np.arctan2(y, x)), np.concatenate([J_azimuth_p @ T_bucket_tool[:3, :3], np.zeros(3)])


def radius_with_jacobian(found: Adjusted) -> tuple[float, float, np.ndarray]:
    """Distance from the pin to the middle of the edge in the plane of the bucket, its sigma, metres, and its (p,)
    Jacobian.
    """
    T = found.T_bucket_tool()
    x, y = T[:2, 3]
    r = float(np.hypot(x, y))
    J = np.zeros(len(found.value))
    J[TOOL] = np.concatenate([np.array([x, y, 0.0]) / r @ T[:3, :3], np.zeros(3)]) @ se3.Jr(found.value[TOOL])
    return r, float(np.sqrt(J @ found.covariance @ J)), J


def written(found: Adjusted) -> Written:
    """Curve and tool for the file.

    Raises
    ------
    FloatingPointError
        The file's bars cannot make the adjusted angles.
    """
    rig = found.rig
    raw = np.array([stand.raw for stand in found.stands])
    low, high = float(raw.min()), float(raw.max())
    beyond = BEYOND * (high - low)
    nodes = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)[::-1]
    at = 0.5 * (low + high) + (0.5 * (high - low) + beyond) * nodes
    held, _ = azimuth_of(rig.T_bucket_tool)
    told = direction(found, at)
    angle = told.angle_rad - held
    target = angle if rig.output == "angle_deg" else _whole_turns(angle)
    if rig.output == "cylinder_m":
        y = linkage.cylinder_length(target, rig.bars, rig.side)
        if not np.all(np.isfinite(y)):
            raise FloatingPointError("the bars of the file cannot make the adjusted angles")
    else:
        y = np.rad2deg(target)
    _, J_angle_y, _ = angle_of(rig, y, np.zeros(9))
    J_y = told.J / J_angle_y[:, None]
    inside = (at >= low) & (at <= high)
    u = (at - found.middle) / found.half
    fitted = None
    for count in range(rig.coefficients, MOST_COEFFICIENTS + 1):
        powers = u[:, None] ** np.arange(count)
        fit = np.linalg.pinv(powers)
        c, J_c = fit @ y, fit @ J_y
        misfit = np.abs((powers @ c - y) * J_angle_y)[inside].max()
        covariance = J_c @ found.covariance @ J_c.T
        sigma = np.sqrt(np.einsum("ni,ij,nj->n", powers, covariance, powers)) * np.abs(J_angle_y)
        off = np.abs(sigma / told.sigma_rad - 1.0)[inside].max()
        fitted = c, covariance, float(misfit), float(off)
        if misfit < MISFIT_RAD and off < SIGMA_OFF:
            break
    assert fitted is not None
    c, covariance, misfit, off = fitted
    to_raw = powers_of_raw(len(c), found.middle, found.half)
    T_tool, tool = _held_tool(found, held)
    return Written(
        to_raw @ c,
        to_raw @ covariance @ to_raw.T,
        (low - beyond, high + beyond),
        (low, high),
        T_tool,
        tool,
        misfit,
        off,
    )


def of_file(rig: Rig, kept: Written, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direction of the edge (n,) at readings as the new file gives it, and its sigma, radians."""
    powers = np.asarray(raw, float)[:, None] ** np.arange(len(kept.coefficients))
    angle, J_y, _ = angle_of(rig, powers @ kept.coefficients, np.zeros(9))
    sigma = np.sqrt(np.einsum("ni,ij,nj->n", powers, kept.covariance, powers)) * np.abs(J_y)
    return angle + azimuth_of(kept.T_bucket_tool)[0], sigma


def monotone(rig: Rig, kept: Written) -> bool:
    """Whether curve and angle rise or fall throughout the readings that are used."""
    raw = np.linspace(*kept.raw_range, 201)
    y = raw[:, None] ** np.arange(len(kept.coefficients)) @ kept.coefficients
    angle, _, _ = angle_of(rig, y, np.zeros(9))
    if not np.all(np.isfinite(angle)):
        return False
    steps, turns = np.diff(y), np.diff(np.unwrap(angle))
    return bool((np.all(steps > 0) or np.all(steps < 0)) and (np.all(turns > 0) or np.all(turns < 0)))


def _held_tool(found: Adjusted, held: float) -> tuple[np.ndarray, np.ndarray]:
    """The adjusted tool turned about the pin until it points where the file's did, and its covariance."""
    T = found.T_bucket_tool()
    azimuth, J_azimuth = azimuth_of(T)
    back = se3.from_rotation_translation(so3.exp(np.array([0.0, 0.0, held - azimuth])), np.zeros(3))
    T_new = back @ T
    about_pin = se3.Ad(se3.inverse(T_new))[:, 5]
    M = (np.eye(6) - np.outer(about_pin, J_azimuth)) @ se3.Jr(found.value[TOOL])
    covariance = M @ found.covariance[TOOL, TOOL] @ M.T
    return T_new, 0.5 * (covariance + covariance.T)


def _whole_turns(angle: np.ndarray) -> np.ndarray:
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)
