"""What was measured against what the network predicts: corners and sensor readings, with their Jacobians.

Residuals are observed minus predicted; the Jacobians are those of the residual, so they carry the minus sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.values import Statics, Values
from pipeline.geometry import camera as camera_model
from pipeline.geometry import linkage
from pipeline.network import frames as fr
from pipeline.network.model import Sensor

TURN_COLUMN = 5
"""A joint turns about z of the child frame: the last component of ``xi``."""


@dataclass(frozen=True, eq=False)
class Corners:
    """All sightings of one marker by one camera: the same path, many epochs."""

    camera: int
    marker: int
    path: tuple[fr.Step, ...]
    intrinsics: int
    """Index of the static."""
    rows: np.ndarray
    """(n,) rows of the epochs' observations."""
    epoch: np.ndarray
    """(n,) rising."""
    p_marker: np.ndarray
    """(n, 4, 3) corners in the marker frame."""
    uv: np.ndarray
    """(n, 4, 2)."""
    whitener: np.ndarray
    """(n, 4, 2, 2) lower triangular ``L^-1`` of the corner's covariance ``L L'``."""
    share: np.ndarray
    """(n,) how much of its information a sighting keeps, because its errors come back: see ``repeated.py``."""
    offset: int | None = None
    """Index of the static with the constant errors of the corners, px; the group is then of one tag."""


@dataclass(frozen=True, eq=False)
class Jacobians:
    """Of whitened residuals (n, m), by what they depend on."""

    variables: dict[int, np.ndarray]
    """By variable: (n, m, size of its state block)."""
    statics: dict[int, np.ndarray]
    """By static: (n, m, r)."""


def corner_residuals(corners: Corners, values: Values, statics: Statics, jacobians=True):
    """Whitened residuals of every corner; after eq. (1) of the paper, with C among the unknowns.

    Parameters
    ----------
    corners : Corners
        One group.
    values : Values
        Of all unknowns.
    statics : Statics
        How values follow from the unknowns.
    jacobians : bool
        Whether to compute them; else None comes back in their place.

    Returns
    -------
    r : (n, 8) array
        Whitened; u, v of corner 0, then of 1, 2, 3. nan where a corner lies behind the camera.
    J : Jacobians or None
    """
    n = len(corners.epoch)
    children, T = fr.along(corners.path, lambda edge: values.edge_pose(statics, edge, corners.epoch))
    p = np.einsum("...ij,...kj->...ki", T[..., :3, :3], corners.p_marker) + T[..., None, :3, 3]
    intrinsics = statics.value(corners.intrinsics, values.z)
    constant = 0.0 if corners.offset is None else statics.value(corners.offset, values.z).reshape(4, 2)
    if not jacobians:
        uv = camera_model.project(p, intrinsics) + constant
        return np.einsum("nkij,nkj->nki", corners.whitener, corners.uv - uv).reshape(n, 8), None
    uv, J_uv_p, J_uv_intrinsics = camera_model.project_with_jacobians(p, intrinsics)
    r = np.einsum("nkij,nkj->nki", corners.whitener, corners.uv - uv - constant).reshape(n, 8)
    J_r_p = -(corners.whitener @ J_uv_p)
    by_variable: dict[int, np.ndarray] = {}
    by_static: dict[int, np.ndarray] = {}
    for step, T_camera_child in zip(corners.path, children, strict=True):
        index = step.edge.index
        if step.edge.kind == "static" and len(statics.columns[index]) == 0:
            continue
        R = T_camera_child[..., :3, :3]
        p_child = np.einsum("...ji,...kj->...ki", R, p - T_camera_child[..., None, :3, 3])
        J_rho = step.sign * (J_r_p @ R[..., None, :, :])
        # d p_camera = R [I, -hat(p_child)] xi; a' hat(b) = (a x b)', row by row.
        if step.edge.kind == "joint":
            J_turn = -np.cross(J_rho, p_child[:, :, None, :])[..., TURN_COLUMN - 3].reshape(n, 8)
            J_turn = step.edge.ratio * J_turn
            time_s = values.time_s[corners.epoch]
            by_rate = np.broadcast_to(-statics.clock_error(index, values.z, time_s), n)[:, None] * J_turn
            J = np.stack([J_turn, by_rate], axis=-1)
            by_variable[index] = by_variable.get(index, 0.0) + J  # a belt may bring one angle in twice
            clock = statics.clocks[index]
            if clock is not None and len(statics.columns[clock]):
                J_clock = -J_turn * values.rate[index][corners.epoch][:, None]
                J = J_clock[..., None] * statics.lateness_by(clock, values.z, time_s)[:, None]
                by_static[clock] = by_static.get(clock, 0.0) + J
            continue
        J = np.concatenate([J_rho, -np.cross(J_rho, p_child[:, :, None, :])], axis=-1)
        if step.edge.kind == "moving":
            full = np.zeros((n, 8, 12))
            full[..., :6] = J.reshape(n, 8, 6)
            by_variable[index] = full
        else:
            by_static[index] = J.reshape(n, 8, 6) @ statics.sensitivity(index, values.z)
    if len(statics.columns[corners.intrinsics]):
        J = -(corners.whitener @ J_uv_intrinsics).reshape(n, 8, 9)
        by_static[corners.intrinsics] = J @ statics.sensitivity(corners.intrinsics, values.z)
    if corners.offset is not None and len(statics.columns[corners.offset]):
        S = statics.sensitivity(corners.offset, values.z).reshape(4, 2, -1)
        by_static[corners.offset] = -(corners.whitener @ S).reshape(n, 8, S.shape[-1])  # -1 fails on no rows
    return r, Jacobians(by_variable, by_static)


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """All readings of one sensor."""

    sensor: Sensor
    variable: int
    epoch: np.ndarray
    """(n,) rising."""
    dt_s: np.ndarray
    """(n,) nominal true time of the reading minus its epoch."""
    raw: np.ndarray
    """(n,)."""
    sigma: np.ndarray
    """(n,) standard deviation of what the curve makes of a reading, m or rad: its slope, at the file's coefficients,
    times the noise of a raw reading."""


def measured_sigma(sensor: Sensor, coefficients, raw):
    """Standard deviation of the measured length (m) or angle (rad) of raw readings; (n,)."""
    slope = np.polynomial.polynomial.polyval(raw, np.polynomial.polynomial.polyder(coefficients))
    unit = 1.0 if sensor.linkage is not None else np.deg2rad(1.0)
    # A curve that is flat somewhere would make that reading exact.
    typical = np.median(np.abs(slope)) if len(raw) else 1.0
    return np.maximum(np.abs(slope), 1e-3 * max(typical, 1e-12)) * sensor.noise * unit


def sensor_residuals(readings: SensorReadings, values: Values, statics: Statics, jacobians=True):
    """Whitened residuals of sensor readings: what the curve measures minus what the angle predicts.

    Both the length of the cylinder (or the angle) and the curve are compared on the measured side, because the curve
    runs from raw to measured and its inverse would have to be solved for. The angle is taken
    at the time of the reading, ``angle + rate dt``. The first sensor of a joint is its clock (see ``Variable.clock``);
    a second one is late against it by the difference of their offsets' errors.

    Returns
    -------
    r : (n, 1) array
        nan where the linkage cannot be.
    J : Jacobians or None
    """
    sensor, k = readings.sensor, readings.variable
    own_clock = statics.clocks[k] == sensor.offset
    dt, time_s = readings.dt_s, values.time_s[readings.epoch]
    if not own_clock:
        late = statics.lateness(sensor.offset, values.z, time_s)
        dt = dt + late - statics.clock_error(k, values.z, time_s)
    rate = values.rate[k][readings.epoch]
    angle = values.pose[k][readings.epoch] + rate * dt
    curve = statics.value(sensor.curve, values.z)
    measured = np.polynomial.polynomial.polyval(readings.raw, curve)
    powers = readings.raw[:, None] ** np.arange(len(curve))
    J_length_params = None
    if sensor.linkage is None:
        unit = np.deg2rad(1.0)
        off = np.mod(unit * measured - angle + np.pi, 2 * np.pi) - np.pi
        J_measured_angle = np.ones(len(angle))
    else:
        unit = 1.0
        params = statics.value(sensor.linkage, values.z)
        length = linkage.cylinder_length(angle, params, sensor.side)
        off = measured - length
        if jacobians:
            _, J_angle_length, J_angle_params = linkage.bucket_angle_with_jacobians(
                length, params, sensor.side
            )
            J_measured_angle = 1 / J_angle_length
            J_length_params = -J_angle_params * J_measured_angle[:, None]
    r = (off / readings.sigma)[:, None]
    if not jacobians:
        return r, None
    scale = 1 / readings.sigma[:, None, None]
    J_state = -np.stack([J_measured_angle, J_measured_angle * dt], axis=-1)[:, None, :] * scale
    by_static = {
        sensor.curve: (unit * powers)[:, None, :] * scale @ statics.sensitivity(sensor.curve, values.z)
    }
    if not own_clock:
        J_late = (-J_measured_angle * rate)[:, None, None] * scale
        by_static[sensor.offset] = J_late * statics.lateness_by(sensor.offset, values.z, time_s)[:, None]
        clock = statics.clocks[k]
        if clock is not None:
            by_static[clock] = -J_late * statics.lateness_by(clock, values.z, time_s)[:, None]
    if sensor.linkage is not None:
        assert J_length_params is not None
        by_static[sensor.linkage] = (
            -J_length_params[:, None, :] * scale @ statics.sensitivity(sensor.linkage, values.z)
        )
    kept = {s: J for s, J in by_static.items() if J.shape[-1]}
    return r, Jacobians({k: J_state}, kept)
