"""What an adjustment says about itself, for solution.json and the report: classes, worst offenders, halves, changes."""

from __future__ import annotations

import math

import numpy as np

from pipeline.config.site import EstimationSettings
from pipeline.detection.found import sides_px
from pipeline.detection.stillness import SIZE_CLASSES
from pipeline.errors import EstimationError
from pipeline.estimation import approach, changes, split, validation
from pipeline.estimation.diagnostics import Fit
from pipeline.estimation.marginals import Marginals
from pipeline.estimation.optimise import Optimum
from pipeline.estimation.problem import Problem
from pipeline.estimation.steps import testable

WORST = 10
"""Tags that are listed."""
HALVED = 32
"""Stretches of 256 epochs, evenly over the log, of which odd and even frames are compared: as many frames tell the
ratio to a hundredth, and the normal equations of both halves take 30 kB an epoch."""
CHECKED = 0.05
"""A measurement with less redundancy is checked by nothing, and its normalised residual is noise over nothing."""


def examine(
    problem: Problem,
    optimum: Optimum,
    settings: EstimationSettings,
    found: Marginals,
    edge_seen,
    corner_fits: list[Fit],
    sensor_fits: list[Fit],
) -> tuple[dict, list[str]]:
    """Figures for solution.json, and the sentences that the operator should read.

    Parameters
    ----------
    problem, optimum, settings, found
        The adjustment, its settings and its marginals.
    edge_seen : (E,) bool array
        Epochs at which the cutting edge was observed.
    corner_fits, sensor_fits : list of Fit
        Per group and per sensor.
    """
    steps: tuple[split.Step, ...] = ()
    halves: dict = {}
    why = ""
    # The answer stands without them: what these two cannot solve is said, and no reason to have no report.
    try:
        if settings.cross_validation:
            epochs = approach.stretches(problem, HALVED)
            part, weights = approach.of_stretches(problem, optimum.weights, epochs)
            values = approach.at_epochs(optimum.values, epochs)
            halves = validation.odd_even(part, values, weights, edge_seen[epochs])
        steps, _, _ = split.trace(problem, optimum, settings.huber, settings.max_iterations)
    except (EstimationError, np.linalg.LinAlgError) as error:
        why = f"without the damping of the adjustment it could not be solved ({error})"
    told = [describe(problem, step) for step in steps]
    predicted = validation.left_out(problem, optimum.values, found)
    sentences = [one["sentence"] for one in told]
    for name, one in predicted.items():
        if one.get("off", False):
            e, n, h = one["difference_mm"]
            sentences.append(
                f"benchmark {name} is not where the rest of the log puts it: by {e:+.0f} mm in easting, {n:+.0f} in "
                f"northing, {h:+.0f} in elevation, {one['normalised']:.1f} sigma; survey it again"
            )
    figures = {
        "classes": classes(problem, corner_fits, sensor_fits),
        "worst": worst(problem, corner_fits),
        "left_out": predicted,
        "odd_even": halves,
        "changes": {
            "tested": [problem.network.statics[s].name for s in testable(problem)],
            "instants": len(changes.instants(problem)),
            "needed": changes.FEWEST,
            "why": why,
            "found": told,
        },
    }
    return figures, sentences


def classes(problem: Problem, corner_fits: list[Fit], sensor_fits: list[Fit]) -> list[dict]:
    """Per camera and size of the tags, and per sensor: count, redundancy number, normalised residuals.

    A normalised residual is the whitened residual over the root of its redundancy number: N(0, 1) if the stated sigma
    is true, however strongly the measurement itself bent the answer.
    """
    rows = []
    for c, camera in enumerate(problem.network.cameras):
        own = [
            (f, sides_px(g.uv)) for g, f in zip(problem.corners, corner_fits, strict=True) if g.camera == c
        ]
        for size in SIZE_CLASSES:
            inside = [(f, (side >= size.low_px) & (side < size.high_px)) for f, side in own]
            high = None if math.isinf(size.high_px) else size.high_px
            name = {"class": "corners", "source": camera.name, "low_px": size.low_px, "high_px": high}
            rows += _class_row(name, inside)
    for readings, fit in zip(problem.sensors, sensor_fits, strict=True):
        name = {"class": "readings", "source": readings.sensor.name, "low_px": None, "high_px": None}
        rows += _class_row(name, [(fit, np.ones(len(fit.r), dtype=bool))])
    return rows


def _class_row(name: dict, parts) -> list[dict]:
    r = np.concatenate([f.r[m].ravel() for f, m in parts]) if parts else np.zeros(0)
    if len(r) == 0:
        return []
    weight = np.concatenate([f.weight[m].ravel() for f, m in parts])
    redundancy = np.concatenate([f.redundancy[m].ravel() for f, m in parts])
    used = (weight > 0) & (redundancy > CHECKED)
    normalised = r[used] / np.sqrt(redundancy[used])
    return [
        {
            **name,
            "measurements": len(r),
            "redundancy": round(float(redundancy[weight > 0].mean()), 3) if np.any(weight > 0) else None,
            "rms_normalised": round(float(np.sqrt(np.mean(normalised**2))), 3) if np.any(used) else None,
            "beyond_3_percent": round(100 * float(np.mean(np.abs(normalised) > 3)), 2)
            if np.any(used)
            else None,
            "down_weighted_percent": round(100 * float(np.mean(weight < 1)), 2),
        }
    ]


def worst(problem: Problem, corner_fits: list[Fit]) -> list[dict]:
    """The tags with the largest normalised residual of a corner, one row each, the worst first."""
    rows: list[dict] = []
    seen, network = problem.epochs.observations, problem.network
    for group, fit in zip(problem.corners, corner_fits, strict=True):
        with np.errstate(invalid="ignore"):
            length = np.linalg.norm(fit.r.reshape(len(fit.r), 4, 2), axis=-1)
        # Of what was left out as gross, the redundancy number is 0 and the residual is all there is.
        share = np.where(
            fit.weight[:, ::2] > 0, np.maximum(fit.redundancy.reshape(-1, 4, 2).mean(-1), CHECKED), 1.0
        )
        normalised = np.nan_to_num(length / np.sqrt(share), nan=0.0)
        each = normalised.max(axis=1)
        for i in np.argsort(-each, kind="stable")[:WORST]:
            row = group.rows[i]
            corner = int(np.argmax(normalised[i]))
            rows.append(
                {
                    "camera": network.cameras[group.camera].name,
                    "marker": network.markers[group.marker].name,
                    "tag_id": int(network.tag_id[seen.tag[row]]),
                    "corner": corner,
                    "time_ns": int(seen.time_ns[row]),
                    "side_px": round(float(sides_px(group.uv[i])), 1),
                    "normalised": round(float(each[i]), 2),
                    "redundancy": round(float(fit.redundancy[i, 2 * corner]), 3),
                    "weight": round(float(fit.weight[i, 2 * corner]), 3),
                }
            )
    return sorted(rows, key=lambda row: row["normalised"], reverse=True)[:WORST]


def describe(problem: Problem, step: split.Step) -> dict:
    """A change in words and numbers."""
    network, time_ns, change = problem.network, problem.epochs.time_ns, step.change
    static = network.statics[step.static]
    name = static.name
    first, last = int(time_ns[change.first]), int(time_ns[change.last])
    others = [network.statics[s].name for s in step.others]
    amounts = amounts_of(step, static)
    plain = name.removesuffix(" pose").removesuffix(" mount")
    text = f"{plain} moved " + " and ".join(a["text"] for a in amounts)
    if others:
        names = " or ".join(o.removesuffix(" pose").removesuffix(" mount") for o in others)
        text += f" (or {names}: this log cannot tell which)"
    at = np.datetime64(int(time_ns[change.epoch]), "ns").astype("datetime64[ms]").item()
    stamp = f"{at:%Y-%m-%dT%H:%M:%S}.{at.microsecond // 1000:03d}Z"
    text += (
        f" between {_clock(first)} and {_clock(last)} UTC; if that is so, split it there: "
        f'[[estimation.split]] static = "{name}", at = {stamp} in site.toml'
    )
    return {
        "static": name,
        "or": others,
        "at_ns": int(time_ns[change.epoch]),
        "from_ns": first,
        "to_ns": last,
        "amounts": amounts,
        "shift": [float(f"{v:.6g}") for v in step.shift],
        "sigma": [float(f"{v:.3g}") for v in np.sqrt(np.diagonal(step.cov))],
        "statistic": round(change.statistic, 1),
        "log10_chance": round(change.log_p / math.log(10), 1),
        "inflation": round(change.inflation, 2),
        "sentence": text,
    }


def amounts_of(step: split.Step, static) -> list[dict]:
    """How far, with one sigma along the way: millimetres and degrees of a pose, else component by component."""
    out = []
    if static.is_pose:
        for part, factor, unit, digits in (
            (slice(0, 3), 1000.0, "mm", 1),
            (slice(3, 6), math.degrees(1.0), "deg", 3),
        ):
            size = float(np.linalg.norm(step.shift[part]))
            way = step.shift[part] / max(size, 1e-12)
            sigma = float(np.sqrt(way @ step.cov[part, part] @ way))
            if size > 3 * sigma:
                out.append(_amount(size * factor, sigma * factor, unit, digits))
        if out:
            return out
    sigma = np.sqrt(np.maximum(np.diagonal(step.cov), 0.0))
    k = int(np.argmax(np.abs(step.shift) / np.maximum(sigma, 1e-300)))
    if static.units[k] == "s":
        return [_amount(1000 * float(step.shift[k]), 1000 * float(sigma[k]), "ms", 1)]
    amount = _amount(float(step.shift[k]), float(sigma[k]), static.units[k], 5)
    return [{**amount, "text": f"{static.components[k]} by {amount['text']}"}]


def _amount(size: float, sigma: float, unit: str, digits: int) -> dict:
    text = f"{size:.{digits}f} {unit} ± {sigma:.{digits}f}"
    return {"size": round(size, digits + 2), "sigma": round(sigma, digits + 2), "unit": unit, "text": text}


def _clock(time_ns: int) -> str:
    at = np.datetime64(time_ns, "ns").astype("datetime64[ms]").item()
    return f"{at:%H:%M:%S}.{at.microsecond // 100000}"
