"""The sheet of a calibrated bucket: how well its angle is known over the stroke, and how well the touches agree."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from pipeline.calibration import curve_fit
from pipeline.calibration.curve_fit import Written
from pipeline.calibration.touches import TOOL, Adjusted
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import GOOD, OPEN, POOR, Part, Picture, Sheet
from pipeline.report.units import text_of
from pipeline.report.words import Words

K = 2.0
STEPS = 61
UNLIKELY = 1e-3
"""Chance of residuals as large as these below which the sigmas are said to be too small."""


@dataclass(frozen=True, eq=False)
class BucketFacts:
    """Everything the sheet says."""

    machine: str
    sensor: str
    adjusted: Adjusted
    kept: Written | None
    """None where only the wear was asked for."""
    touch_names: tuple[str, ...]
    point_names: tuple[str, ...]
    left_out: Mapping[str, int]
    wear_m: float | None
    """Of the teeth since the mount was measured."""
    tolerance_m: float
    """What the bucket may use of the job's tolerance."""
    date: datetime.date
    log: str
    log_sha256: str
    checks: str | None
    machine_sha256: str

    @property
    def stroke(self) -> np.ndarray:
        """(STEPS,) readings over the touches."""
        raw = [stand.raw for stand in self.adjusted.stands]
        return np.linspace(min(raw), max(raw), STEPS)

    @property
    def wear_sigma_m(self) -> float:
        return float(np.sqrt(self.adjusted.covariance[TOOL, TOOL][2, 2]))

    @property
    def expanded_m(self) -> float:
        """U of the edge, k = 2: the worst over the stroke."""
        return K * float(edge_sigma(self.adjusted, self.stroke).max())

    @property
    def good(self) -> bool:
        return self.expanded_m <= self.tolerance_m


def edge_sigma(adjusted: Adjusted, raw: np.ndarray) -> np.ndarray:
    """(n,) largest standard deviation of the middle of the edge in the bucket's plane, as seen from the pin, metres."""
    told = curve_fit.direction(adjusted, raw)
    r, _, J_r = curve_fit.radius_with_jacobian(adjusted)
    J = np.stack([r * told.J, np.broadcast_to(J_r, told.J.shape)], axis=1)
    covariance = J @ adjusted.covariance @ np.swapaxes(J, 1, 2)
    return np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])


def bucket_sheet(facts: BucketFacts, language: str = "en") -> Sheet:
    """The sheet."""
    words = Words(language)

    def say(key: str, **places: object) -> str:
        return words(f"bucket.{key}", **places)

    adjusted = facts.adjusted
    raw = facts.stroke
    told = curve_fit.direction(adjusted, raw)
    angle_deg, sigma_deg = np.rad2deg(np.unwrap(told.angle_rad)), np.rad2deg(told.sigma_rad)
    r, sigma_r, _ = curve_fit.radius_with_jacobian(adjusted)
    statistic, redundancy = adjusted.chi_square()
    unlikely = redundancy > 0 and chi2.sf(statistic, redundancy) < UNLIKELY
    state = OPEN if unlikely else GOOD if facts.good else POOR
    sentence = say(
        state,
        u=text_of(1000 * facts.expanded_m, 1),
        radius=text_of(r, 2),
        limit=text_of(1000 * facts.tolerance_m, 1),
    )
    residual_mm = 1000 * adjusted.residual
    remarks = []
    if unlikely:
        remarks.append(say("unlikely", value=text_of(statistic / redundancy, 1), redundancy=redundancy))
    if facts.left_out:
        remarks.append(
            say("left_out", rows=", ".join(f"{n} {reason}" for reason, n in facts.left_out.items()))
        )
    if facts.kept is not None:
        remarks.append(
            say(
                "beyond",
                low=text_of(facts.kept.stroke[0], 3),
                high=text_of(facts.kept.stroke[1], 3),
            )
        )
    numbers = [
        (say("stands"), number(len(adjusted.stands)), say("turn", turn=text_of(float(np.ptp(angle_deg)), 0))),
        (say("angle"), number(float(sigma_deg.max()), "°", 3), say("angle_note")),
        (say("radius"), number(1000 * r, "mm", 1), say("sigma", sigma=text_of(1000 * sigma_r, 1))),
        (
            say("residuals"),
            number(float(np.sqrt(np.mean(residual_mm**2))), "mm", 1),
            say("worst", worst=text_of(float(np.abs(residual_mm).max()), 1)),
        ),
    ]
    if facts.wear_m is not None:
        note = say("sigma", sigma=text_of(1000 * facts.wear_sigma_m, 1))
        numbers.append((say("wear"), number(1000 * facts.wear_m, "mm", 1), note))
    curve = table(
        [
            column("raw", say("raw"), "", 3),
            column("angle", say("direction"), "°", 2),
            column("sigma", say("angle_sigma"), "°", 3),
            column("edge", say("edge_sigma"), "mm", 1),
        ],
        [
            {"raw": a, "angle": b, "sigma": c, "edge": d}
            for a, b, c, d in zip(raw, angle_deg, sigma_deg, 1000 * edge_sigma(adjusted, raw))
        ][:: STEPS // 12],
    )
    touches = table(
        [
            column("name", say("touch"), kind="id"),
            column("raw", say("raw"), "", 3),
            column("angle", say("direction"), "°", 1),
            column("e", say("e"), "mm", 1, True),
            column("n", say("n"), "mm", 1, True),
            column("h", say("h"), "mm", 1, True),
        ],
        [
            {
                "name": name,
                "raw": adjusted.stands[touch.stand].raw,
                "angle": np.interp(adjusted.stands[touch.stand].raw, raw, angle_deg),
                "e": v[0],
                "n": v[1],
                "h": v[2],
            }
            for name, touch, v in zip(facts.touch_names, adjusted.touches, residual_mm)
        ],
    )
    parts = [
        Part(
            say("stroke"),
            [say("gauge")],
            pictures=[
                Picture(
                    "angle-sigma",
                    say("figure"),
                    say("figure_good"),
                    say("figure_description", worst=text_of(float(sigma_deg.max()), 3)),
                    lambda: _draw(adjusted, raw, angle_deg, sigma_deg, say),
                    curve,
                )
            ],
        ),
        Part(say("touches"), [say("touches_text")], tables=[(say("touches_caption"), touches)]),
    ]
    if facts.kept is not None:
        parts.append(Part(say("written"), [_of_file(facts.kept, say)]))
    origin = {
        say("log"): f"{facts.log}, sha256 {facts.log_sha256[:16]}",
        say("recorded"): facts.date.isoformat(),
        say("machine_file"): f"sha256 {facts.machine_sha256[:16]}",
    }
    if facts.checks:
        origin[say("checks")] = facts.checks
    return Sheet(
        say("title"), f"{facts.machine}, {facts.sensor}", state, sentence, numbers, remarks, parts, origin
    )


def _of_file(kept: Written, say) -> str:
    return str(
        say(
            "kept",
            n=len(kept.coefficients),
            misfit=text_of(float(np.rad2deg(kept.misfit_rad)), 4),
            off=text_of(100 * kept.sigma_off, 1),
            low=text_of(kept.raw_range[0], 3),
            high=text_of(kept.raw_range[1], 3),
        )
    )


def _draw(adjusted: Adjusted, raw: np.ndarray, angle_deg: np.ndarray, sigma_deg: np.ndarray, say) -> Figure:
    figure = new_figure(2.6)
    ax = figure.subplots()
    ax.plot(angle_deg, sigma_deg, color=palette.AS_BUILT)
    at = [float(np.interp(stand.raw, raw, angle_deg)) for stand in adjusted.stands]
    ax.plot(at, np.zeros(len(at)), "|", color=palette.DESIGN, markersize=10, clip_on=False)
    ax.set_ylim(0, 1.15 * float(sigma_deg.max()))
    ax.set_xlabel(f"{say('direction')} [°]")
    ax.set_ylabel(f"{say('angle_sigma')} [°]")
    return figure
