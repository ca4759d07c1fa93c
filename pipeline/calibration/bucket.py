"""What the bucket's sensor and its cutting edge are, told by points that the edge touched.

One touch: the machine stands still with its edge on a known point, or a total station measures a tooth while it
stands. The cameras tell where the stick is, so

    p = T_world_axis exp(a) Rz(angle(raw)) T_bucket_tool exp(t) p_tool  -  d

with ``angle = linkage(curve(raw))``, or the curve alone. Unknown are the curve, the bars of the linkage, the pin on the
stick ``a``, the tool ``t``, the errors ``f`` that the poses of all touches share, and the error ``d`` of each known
point. All but the curve have a prior. In the plane of the bucket, the part of a touch towards the pin tells the
distance from pin to edge, the part across it tells the angle.

An angle in this chain shows only as a sum: of the axis about its own z, of the curve's zero, of the horn and of the
direction from pin to edge. Here each keeps its prior and nothing is held; what stands in the file afterwards is chosen
in `curve_fit`. The axis about z is exact: angle zero is where the file says that the axis frame's x points.

The curve is a sum of powers of ``u``, the raw reading brought to -1 .. 1 over the touches, so that its prior can be
wide (`WIDE`) in every coefficient without a loss of digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.calibration.touches import (
    AXIS,
    BARS,
    CURVE_FROM,
    TOOL,
    Adjusted,
    Rig,
    Stand,
    Touch,
    angle_of,
    powers_of_raw,
)
from pipeline.geometry import linkage, se3, so3

WIDE = {"cylinder_m": 2.0, "angle_deg": 400.0}
"""Prior sigma of each coefficient over ``u``: no cylinder and no turn is longer."""
HUBER = 2.5
ITERATIONS = 60
STEP_SIGMAS = 1e-6
"""The iteration ends with a step smaller than this in prior or posterior standard deviations."""


def adjust(rig: Rig, stands: Sequence[Stand], touches: Sequence[Touch], points: Sequence[float]) -> Adjusted:
    """Curve, tool and pin from touches, by least squares that begin where the robust ones ended.

    Parameters
    ----------
    rig : Rig
        Priors. Where the file has the curve does not matter.
    stands : sequence of Stand
        At least as many as the curve has coefficients.
    touches : sequence of Touch
        In any order.
    points : sequence of float
        Sigma of each coordinate of each known point, metres.

    Returns
    -------
    Adjusted
        No robust weight is left in it.

    Raises
    ------
    FloatingPointError
        No curve brings the edge near the points within the reach of the bars.
    """
    return _iterate(robust(rig, stands, touches, points), _scale(rig, stands, points), huber=False)


def robust(rig: Rig, stands: Sequence[Stand], touches: Sequence[Touch], points: Sequence[float]) -> Adjusted:
    """The same by robust least squares: a touch that is wrong by metres stays wrong alone.

    The residuals are those of one least-squares step from there, linearised, so that they can be tested (`snooping`)
    as if no weight had been touched.
    """
    middle, half = _stroke(stands)
    shared = stands[0].factors.shape[1]
    mean, scale = _prior(rig, middle, half, shared, points)
    empty = np.zeros((0, 0))
    found = Adjusted(
        rig, tuple(stands), tuple(touches), middle, half, mean, empty, np.zeros((0, 3)), empty, empty,
        shared, mean,
    )  # fmt: skip
    if rig.curve is None:
        found = replace(found, value=_start(found))
    return _iterate(found, scale, huber=True)


def _stroke(stands: Sequence[Stand]) -> tuple[float, float]:
    """Middle and half of the readings."""
    raw = np.array([stand.raw for stand in stands])
    return 0.5 * float(raw.min() + raw.max()), max(0.5 * float(np.ptp(raw)), 1e-12)


def _scale(rig: Rig, stands: Sequence[Stand], points: Sequence[float]) -> np.ndarray:
    return _prior(rig, *_stroke(stands), stands[0].factors.shape[1], points)[1]


def _prior(
    rig: Rig, middle: float, half: float, factors: int, points: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """(p,) means and (p, q) square root of the prior covariance, without columns for what is exact."""
    curve_mean, curve_root = np.zeros(rig.coefficients), np.eye(rig.coefficients) * WIDE[rig.output]
    if rig.curve is not None:
        to_u = np.linalg.inv(powers_of_raw(rig.coefficients, middle, half))
        curve_mean, curve_root = to_u @ rig.curve[0], _root(to_u @ rig.curve[1] @ to_u.T)
    blocks = [
        _root(rig.axis),
        _root(rig.tool),
        _root(rig.bars_covariance if rig.output == "cylinder_m" else np.zeros((9, 9))),
        curve_root,
        np.eye(factors),
        *[np.eye(3) * sigma for sigma in points],
    ]
    scale = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
    row = column = 0
    for block in blocks:
        scale[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    mean = np.zeros(len(scale))
    mean[CURVE_FROM : CURVE_FROM + rig.coefficients] = curve_mean
    return mean, scale


def _root(covariance: np.ndarray) -> np.ndarray:
    sigma = np.sqrt(np.diagonal(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)  # metres and radians are not comparable, correlations are
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    free = values > 1e-12
    return unit[:, None] * vectors[:, free] * np.sqrt(values[free])


def _start(found: Adjusted) -> np.ndarray:
    """First values: the angle that each touch shows, through the bars as the file has them, and a polynomial.

    One touch may be wrong altogether, so the polynomial is fitted without each of them in turn, and the one that most
    others agree with is taken.
    """
    rig = found.rig
    raw, y = [], []
    for touch in found.touches:
        stand = found.stands[touch.stand]
        p_axis = se3.transform(se3.inverse(stand.T_world_axis), touch.p_world)
        p_bucket = se3.transform(rig.T_bucket_tool, _on_tool(rig, touch, 0.0))
        angle = np.arctan2(p_axis[1], p_axis[0]) - np.arctan2(p_bucket[1], p_bucket[0])
        angle = np.pi - np.mod(np.pi - angle, 2 * np.pi)
        raw.append(stand.raw)
        y.append(
            linkage.cylinder_length(angle, rig.bars, rig.side)
            if rig.output == "cylinder_m"
            else np.rad2deg(angle)
        )
    order = np.argsort(raw, kind="stable")
    reading, shown = np.array(raw)[order], np.array(y)[order]
    good = np.isfinite(shown)
    if good.sum() < rig.coefficients:
        raise FloatingPointError("the bars cannot reach the touches")
    reading, shown = reading[good], shown[good]
    if rig.output == "angle_deg":
        shown = np.rad2deg(np.unwrap(np.deg2rad(shown)))
    powers = found.powers(reading)
    best, least = np.zeros(rig.coefficients), np.inf
    for left_out in range(-1, len(reading)):
        kept = np.arange(len(reading)) != left_out
        if kept.sum() < rig.coefficients:
            continue
        c = np.linalg.lstsq(powers[kept], shown[kept], rcond=None)[0]
        misfit = float(np.median(np.abs(powers @ c - shown)))
        if misfit < least * 0.999:
            best, least = c, misfit
    value = found.value.copy()
    value[found.curve] = best
    return value


def _on_tool(rig: Rig, touch: Touch, along_m: float) -> np.ndarray:
    half = 0.5 * rig.width_m
    return np.array([{"left": -half, "middle": 0.0, "right": half}.get(touch.edge_point, along_m), 0.0, 0.0])


def _iterate(found: Adjusted, scale: np.ndarray, huber: bool) -> Adjusted:
    """Gauss-Newton on ``value = mean + scale z`` with ``z ~ N(0, I)``; a curve that is asked for has it nearly flat."""
    value = found.value
    z = np.linalg.lstsq(scale, value - found.mean, rcond=None)[0]
    weight = np.ones(len(found.touches))
    for _ in range(ITERATIONS):
        residual, J, noise = linearised(found, value)
        if not np.all(np.isfinite(J)):
            raise FloatingPointError("the bars cannot reach the touches")
        block = np.repeat(1.0 / np.sqrt(weight), 3)
        whole = noise * np.outer(block, block)
        A = J @ scale
        normal = A.T @ np.linalg.solve(whole, A) + np.eye(scale.shape[1])
        step = np.linalg.solve(normal, A.T @ np.linalg.solve(whole, residual) - z)
        ahead = 1.0
        while ahead > 1e-3 and not _reaches(found, value + ahead * (scale @ step)):
            ahead *= 0.5
        z = z + ahead * step
        value = found.mean + scale @ z
        size = float(np.sqrt(step @ normal @ step))
        if huber:
            before = weight
            residual = linearised(found, value)[0].reshape(-1, 3)
            own = np.array([noise[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(residual))])
            normalised = np.sqrt(np.einsum("ni,nij,nj->n", residual, np.linalg.inv(own), residual) / 3)
            weight = np.minimum(1.0, HUBER / np.maximum(normalised, 1e-12))
            if size < 1e-3 and np.abs(weight - before).max() < 1e-3:
                break
        elif size < STEP_SIGMAS:
            break
    residual, J, noise = linearised(found, value)
    A = J @ scale
    normal = A.T @ np.linalg.solve(noise, A) + np.eye(scale.shape[1])
    covariance = scale @ np.linalg.solve(normal, scale.T)
    if huber:
        residual = residual - A @ np.linalg.solve(normal, A.T @ np.linalg.solve(noise, residual) - z)
    flat = np.any(scale[found.curve] != 0, axis=0) & (found.rig.curve is None)
    return replace(
        found,
        value=value,
        covariance=0.5 * (covariance + covariance.T),
        residual=residual.reshape(-1, 3),
        J=J,
        noise=noise,
        pull=float(np.sum(z[~flat] ** 2)),
    )


def _reaches(found: Adjusted, value: np.ndarray) -> bool:
    moved = replace(found, value=value)
    return bool(np.all(np.isfinite(moved.angle(np.array([s.raw for s in found.stands]))[0])))


def linearised(found: Adjusted, value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(3n,) given minus adjusted, (3n, p) Jacobian of the adjusted, (3n, 3n) covariance of the rest."""
    rig = found.rig
    at = replace(found, value=value)
    raw = np.array([stand.raw for stand in found.stands])
    angle, J_angle = at.angle(raw)
    y_slope = np.polynomial.polynomial.polyval(
        (raw - at.middle) / at.half, np.polynomial.polynomial.polyder(value[at.curve])
    )
    J_angle_y = angle_of(rig, at.output(raw)[0], value[BARS])[1]
    J_angle_raw = J_angle_y * y_slope / at.half
    n, p = len(found.touches), len(value)
    residual, J = np.empty(3 * n), np.zeros((3 * n, p))
    per_stand = np.zeros((3 * n, 7 * len(found.stands)))
    noise = np.zeros((3 * n, 3 * n))
    first_factor = CURVE_FROM + rig.coefficients
    first_point = first_factor + found.factors
    exp_axis, exp_tool = se3.exp(value[AXIS]), se3.exp(value[TOOL])
    Jr_axis, Jr_tool = se3.Jr(value[AXIS]), se3.Jr(value[TOOL])
    for i, touch in enumerate(found.touches):
        stand, k = found.stands[touch.stand], touch.stand
        rows = slice(3 * i, 3 * i + 3)
        turn = se3.from_rotation_translation(so3.exp(np.array([0.0, 0.0, angle[k]])), np.zeros(3))
        T_world_bucket = stand.T_world_axis @ exp_axis @ turn
        T_world_tool = T_world_bucket @ rig.T_bucket_tool @ exp_tool
        along = 0.0
        if not touch.edge_point:
            along = float((touch.p_world - T_world_tool[:3, 3]) @ T_world_tool[:3, 0])
            along = float(np.clip(along, -0.5 * rig.width_m, 0.5 * rig.width_m))
        p_tool = _on_tool(rig, touch, along)
        p_axis = se3.transform(turn @ rig.T_bucket_tool @ exp_tool, p_tool)
        R_axis = (stand.T_world_axis @ exp_axis)[:3, :3]
        p_world = se3.transform(T_world_tool, p_tool)
        lever = p_world - stand.T_world_axis[:3, 3]
        G = np.hstack([np.eye(3), -so3.hat(lever)])
        d_angle = R_axis @ np.array([-p_axis[1], p_axis[0], 0.0])
        J[rows] = np.outer(d_angle, J_angle[k])
        J[rows, AXIS] += R_axis @ np.hstack([np.eye(3), -so3.hat(p_axis)]) @ Jr_axis
        J[rows, TOOL] += T_world_tool[:3, :3] @ np.hstack([np.eye(3), -so3.hat(p_tool)]) @ Jr_tool
        # The shared error turns about the pin whatever moved the edge before.
        shared = stand.factors @ value[first_factor:first_point]
        J[rows] += so3.hat(shared[3:]) @ J[rows]
        J[rows, first_factor:first_point] = G @ stand.factors
        p_given = p_world + G @ shared
        if touch.point >= 0:
            d = slice(first_point + 3 * touch.point, first_point + 3 * touch.point + 3)
            J[rows, d] = -np.eye(3)
            p_given = p_given - value[d]
        residual[rows] = touch.p_world - p_given
        noise[rows, rows] += touch.sigma_m**2 * np.eye(3)
        if not touch.edge_point:
            u = T_world_tool[:3, 0]
            noise[rows, rows] += (0.5 * rig.width_m) ** 2 * np.outer(u, u)
        per_stand[rows, 7 * k : 7 * k + 6] = G @ _symmetric_root(stand.own)
        per_stand[rows, 7 * k + 6] = d_angle * J_angle_raw[k] * stand.raw_sigma
    return residual, J, noise + per_stand @ per_stand.T


def _symmetric_root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def without(found: Adjusted, touch: int, points: Sequence[float]) -> Adjusted:
    """The same adjustment with one touch left out; its stand goes too if no other touch is at it."""
    return robust(found.rig, *left(found.stands, found.touches, touch), points)


def left(stands: Sequence[Stand], touches: Sequence[Touch], touch: int) -> tuple[list[Stand], list[Touch]]:
    """Stands and touches without one touch, and without its stand if no other touch is at it."""
    kept = [t for i, t in enumerate(touches) if i != touch]
    used = sorted({t.stand for t in kept})
    return [stands[k] for k in used], [replace(t, stand=used.index(t.stand)) for t in kept]


def predicted(found: Adjusted, stand: Stand, touch: Touch) -> np.ndarray:
    """(3,) where an adjustment puts a touch that it need not hold: what its coordinates should have been."""
    asked = replace(touch, stand=0)
    moved = replace(found, stands=(stand,), touches=(asked,))
    return touch.p_world - linearised(moved, found.value)[0]
