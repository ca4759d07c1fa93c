"""How well it fits: redundancy, sigma0 squared with its global test, and what moved off its prior."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.stats

from pipeline.estimation.marginals import Marginals
from pipeline.estimation.problem import Problem, Weights, huber, lengths, motion_residual
from pipeline.estimation.residuals import Jacobians, corner_residuals, sensor_residuals
from pipeline.estimation.solution import CornerResiduals, StaticResult
from pipeline.estimation.values import Values
from pipeline.geometry import so3
from pipeline.network.model import Network

MOVED_SIGMAS = 3.5
"""A static further off its file value than this is named: of 75 components one in thirty logs does so by chance."""


STIFF = 1.5
"""Mean square of the whitened motion residuals from which a density is called too small. With a bucket's density a
hundred times too small it was 4, and the slope of its sensor's curve left its file value by 31 sigma to move less."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One group of measurements after the adjustment."""

    r: np.ndarray
    """(n, m) whitened residuals."""
    weight: np.ndarray
    """(n, m) robust weights."""
    redundancy: np.ndarray
    """(n, m) share of each measurement that is checked by the others: ``1 - w (J P J')_ii``, between 0 and 1."""


def fit_corners(problem: Problem, values: Values, weights: Weights, found: Marginals) -> list[Fit]:
    """Residuals, weights and redundancy numbers of every group of corners."""
    fits = []
    for group, alive in zip(problem.corners, weights.corners, strict=True):
        r, J = corner_residuals(group, values, problem.statics)
        assert J is not None
        weight = np.repeat(huber(lengths(r, 2), weights.huber, alive)[0], 2, axis=1)
        kept = group.share[:, None] * weight
        fits.append(Fit(r, weight, _redundancy(problem, found, group.epoch, J, kept)))
    return fits


def fit_sensors(problem: Problem, values: Values, weights: Weights, found: Marginals) -> list[Fit]:
    """The same for every sensor."""
    fits = []
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, J = sensor_residuals(readings, values, problem.statics)
        assert J is not None
        weight = huber(lengths(r, 1), weights.huber, alive)[0]
        fits.append(Fit(r, weight, _redundancy(problem, found, readings.epoch, J, weight)))
    return fits


def _redundancy(problem: Problem, found: Marginals, epoch, J: Jacobians, weight):
    n, m = weight.shape
    M = np.zeros((n, m, problem.statics.size))
    for s, J_s in J.statics.items():
        M[:, :, problem.statics.columns[s]] += J_s
    share = np.zeros((n, m))
    if J.variables:
        c = problem.place(next(iter(J.variables)))[0]
        J_x = np.zeros((n, m, problem.chain_size(c)))
        for k, J_k in J.variables.items():
            J_x[:, :, problem.place(k)[1]] += J_k
        M[:, :, found.columns[c]] -= J_x @ found.Y[c][epoch]
        share += np.einsum("nmi,nij,nmj->nm", J_x, found.Z[c][epoch], J_x, optimize=True)
    share += np.einsum("nmi,nmi->nm", M @ found.P_zz, M)
    return np.where(weight > 0, 1 - weight * share, 0.0)


def corner_table(problem: Problem, fits: list[Fit]) -> CornerResiduals:
    """One row per corner, by camera, marker and time."""
    network, seen = problem.network, problem.epochs.observations
    parts: dict[str, list[np.ndarray]] = {key: [] for key in CornerResiduals.__dataclass_fields__}
    for group, fit in zip(problem.corners, fits, strict=True):
        n = len(group.epoch)
        whitened = fit.r.reshape(n, 4, 2)
        parts["camera"].append(np.full(4 * n, group.camera))
        parts["marker"].append(np.full(4 * n, group.marker))
        parts["tag_id"].append(np.repeat(network.tag_id[seen.tag[group.rows]], 4))
        parts["time_ns"].append(np.repeat(seen.time_ns[group.rows], 4))
        parts["corner"].append(np.tile(np.arange(4), n))
        parts["residual"].append(np.linalg.solve(group.whitener, whitened[..., None])[..., 0].reshape(-1, 2))
        cov = seen.cov[group.rows]
        parts["sigma_px"].append(np.sqrt(0.5 * (cov[..., 0, 0] + cov[..., 1, 1])).ravel())
        parts["normalised"].append(np.linalg.norm(whitened, axis=-1).ravel())
        parts["weight"].append(fit.weight[:, ::2].ravel())
    shape = {"residual": (0, 2)}
    arrays = {key: np.concatenate(v) if v else np.zeros(shape.get(key, 0)) for key, v in parts.items()}
    order = np.lexsort([arrays[key] for key in ("corner", "tag_id", "marker", "camera", "time_ns")])
    return CornerResiduals(**{key: v[order] for key, v in arrays.items()})


def huber_mean_square(k: float, components: int) -> float:
    """Expected weighted square per component of a standard normal vector under Huber's weights.

    ``E[min(1, k/s) s²] / n``: Huber weighs down some good measurements too, and without this factor a perfect
    log would fail its global test as soon as it is long enough.
    """
    tail = math.exp(-0.5 * k * k)
    beyond = math.sqrt(math.pi / 2) * math.erfc(k / math.sqrt(2))  # integral of exp(-s²/2) beyond k
    if components == 2:
        return 0.5 * (2 - (k * k + 2) * tail + k * (k * tail + beyond))
    return math.erf(k / math.sqrt(2))  # one component: what the tail loses in weight it has in length


def motion_fit(problem: Problem, values: Values) -> dict:
    """Per variable: mean square of the whitened motion residual, translation and rotation apart.

    Far below 1 the configured density is larger than what the machine did (averaging is wasted), far above 1 it is
    smaller (the machine is smoothed away). Not a test: the states follow the observations, so less than 1 is normal.
    """
    out = {}
    for k, variable in enumerate(problem.tie.variables):
        e = motion_residual(problem, values, k, jacobians=False)[0] ** 2
        if len(e) == 0:
            continue
        if variable.kind == "joint":
            out[variable.body] = {"rotation": round(float(e.mean()), 4)}
        else:
            by_axis = e.reshape(len(e), 2, 2, 3).mean(axis=(0, 1, 3))
            out[variable.body] = {
                "translation": round(float(by_axis[0]), 4),
                "rotation": round(float(by_axis[1]), 4),
            }
    return out


def stiff_motion(fit: dict) -> list[str]:
    """A sentence for each body that moved more than its motion prior admits."""
    sentences = []
    for body, parts in fit.items():
        for part, value in parts.items():
            if value > STIFF:
                sentences.append(
                    f"body '{body}' accelerated more than motion.{body}.{part} admits (mean square {value:.1f}, at "
                    f"most 1 if it is right): its states are smoothed and its sigmas are too small; multiply the value "
                    f"by about {max(2.0, 2 * value):.0f}"
                )
    return sentences


def variance_component(fits: list[Fit], k: float) -> dict:
    """Sigma0 squared of a class of measurements, with its redundancy and the global test.

    Sum of weighted squares over the sum of redundancy numbers. 1 if the stated sigmas are true; the bounds are those of
    chi-square over its degrees of freedom.
    """
    squares = float(
        sum(np.nansum(f.weight * f.r**2) / huber_mean_square(k, 2 if f.r.shape[1] > 1 else 1) for f in fits)
    )
    redundancy = float(sum(np.sum(f.redundancy) for f in fits))
    count = int(sum(np.sum(f.weight > 0) for f in fits))
    if redundancy < 1:
        return {
            "measurements": count,
            "redundancy": round(redundancy, 1),
            "sigma0_squared": None,
            "passed": None,
        }
    low, high = scipy.stats.chi2.ppf([0.025, 0.975], redundancy) / redundancy
    value = squares / redundancy
    return {
        "measurements": count,
        "redundancy": round(redundancy, 1),
        "sigma0_squared": round(value, 4),
        "bounds_95": [round(float(low), 4), round(float(high), 4)],
        "passed": bool(low <= value <= high),
    }


def pixel_rms(network: Network, table: CornerResiduals) -> dict:
    """Root mean square residual per coordinate, px, of the corners that count, and how many were weighed down."""
    used = table.weight > 0

    def rms(rows):
        return round(float(np.sqrt(np.mean(table.residual[rows] ** 2))), 4) if np.any(rows) else None

    markers = {}
    for k, marker in enumerate(network.markers):
        here = table.marker == k
        if np.any(here):
            markers[marker.name] = {
                "corners": int(np.sum(here)),
                "rms_px": rms(here & used),
                "down_weighted": int(np.sum(here & used & (table.weight < 1))),
                "rejected": int(np.sum(here & ~used)),
            }
    cameras = {
        camera.name: {"corners": int(np.sum(table.camera == k)), "rms_px": rms((table.camera == k) & used)}
        for k, camera in enumerate(network.cameras)
    }
    return {"cameras": cameras, "markers": markers}


def static_results(problem: Problem, values: Values, found: Marginals) -> list[StaticResult]:
    """Every static beside its file value, in the parent's axes."""
    results = []
    for k, static in enumerate(problem.network.statics):
        columns, scale = problem.statics.columns[k], problem.statics.scale[k]
        correction = scale @ values.z[columns]
        prior = scale @ scale.T
        J = problem.statics.sensitivity(k, values.z)
        after = J @ found.P_zz[np.ix_(columns, columns)] @ J.T
        base = problem.statics.base[k]
        if static.is_pose:
            T = problem.statics.value(k, values.z)
            file_value = np.concatenate([base[:3, 3], so3.log(base[:3, :3])])
            value = np.concatenate([T[:3, 3], _nearest_turn(so3.log(T[:3, :3]), file_value[3:])])
            before, chart = _chart(base, file_value[3:]), _chart(T, value[3:])
            correction, prior, after = before @ correction, before @ prior @ before.T, chart @ after @ chart.T
        else:
            file_value, value = base, base + correction
        prior_sigma = np.sqrt(np.maximum(np.diagonal(prior), 0.0))
        free = prior_sigma > 0
        shift = np.where(free, correction / np.where(free, prior_sigma, 1.0), 0.0)
        results.append(
            StaticResult(
                static.name,
                static.source,
                static.components,
                static.units,
                file_value,
                value,
                prior_sigma,
                np.sqrt(np.maximum(np.diagonal(after), 0.0)),
                shift,
            )
        )
    return results


def _chart(T, phi):
    """(6, 6) change of origin and rotation vector of a pose by a perturbation on its right."""
    chart = np.zeros((6, 6))
    chart[:3, :3], chart[3:, 3:] = T[:3, :3], so3.Jr_inv(phi)
    return chart


def _nearest_turn(phi, near):
    """Of the two rotation vectors about half a turn that mean the same the one nearer to another."""
    angle = np.linalg.norm(phi)
    if angle < 0.5 * np.pi:
        return phi
    other = phi * (1 - 2 * np.pi / angle)
    return other if np.linalg.norm(other - near) < np.linalg.norm(phi - near) else phi


def moved_statics(results: list[StaticResult]) -> list[str]:
    """A sentence for each static that the log puts far from its file value."""
    sentences = []
    for result in results:
        worst = int(np.argmax(np.abs(result.shift_sigmas)))
        shift = result.shift_sigmas[worst]
        if abs(shift) < MOVED_SIGMAS:
            continue
        by = result.value[worst] - result.file_value[worst]
        amount = {"m": f"{1000 * by:.1f} mm", "rad": f"{np.rad2deg(by):.3f} deg"}.get(
            result.units[worst], f"{by:.4g} {result.units[worst]}".strip()
        )
        sentences.append(
            f"{result.quantity} moved {abs(shift):.1f} sigma from its file value: {result.components[worst]} "
            f"by {amount}; check that it was not knocked, or calibrate it again"
        )
    return sentences
