"""The page: one dict of everything that is printed, the figures beside it, and the HTML made of both.

The dict is report.json. Templates print it and compute nothing, so what the page says and what
report.json says cannot part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pipeline.report import (
    causes,
    charts,
    detector,
    evidence,
    facts,
    histograms,
    maps,
    measured,
    numbers,
    profiles,
    quantities,
    utilities,
    views,
)
from pipeline.report.attention import attention, no_statistics
from pipeline.report.consistency import consistency
from pipeline.report.drawing import house_style, svg_of
from pipeline.report.evidence import Timeline
from pipeline.report.hand_off import AS_BUILT_POINTS, files_table, hand_off_of, points_table
from pipeline.report.identity import identity, settings
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.printing import printed
from pipeline.report.provenance import method, provenance
from pipeline.report.report_file import FORMAT
from pipeline.report.units import Units, text_of, units_of
from pipeline.report.words import Words
from pipeline.surface.checks import ENOUGH
from pipeline.surface.hand_off import HandOff


@dataclass(frozen=True)
class Page:
    """A rendered report."""

    html: str
    content: dict[str, Any]
    """report.json."""
    exports: dict[str, dict[str, Any]]
    """Whole tables for CSV files: ``stations``, ``checks``, ``as_built_pnezd``; only those that there are."""
    hand_off: HandOff | None
    """What the drawings hold; None where there is no alignment."""


def render(inputs: ReportInputs, language: str = "en") -> Page:
    """The page of a run and the dict of every number on it; the same inputs give the same bytes."""
    words = Words(language)
    units = units_of(inputs.site.grid.unit, inputs.site.grid.metres_per_unit)
    content, pictures = compose(inputs, units, words)
    exports, hand_off = _exports(inputs, units, words), hand_off_of(inputs, units)
    content["hand_off"] = {
        "files": files_table(exports, hand_off is not None, words),
        "as_built_points": exports.get(AS_BUILT_POINTS),
    }
    html = printed("report.html", content, pictures, words)
    return Page(html, content, exports, hand_off)


def compose(inputs: ReportInputs, units: Units, words: Words) -> tuple[dict[str, Any], dict[str, str]]:
    """Everything that is printed, and the figures as SVG by name."""
    stations, checks, as_built = (inputs.table(name) for name in ("stations", "checks", "as_built"))
    grid = None if as_built is None else measured.grid_of(as_built, inputs.design)
    timeline = evidence.timeline_of(inputs)
    statistics = measured.check_statistics(inputs, units)
    sections = [] if grid is None else measured.sections_of(inputs, grid)
    main, beyond = (None, None) if stations is None else measured.split_stations(stations, units, words)
    content: dict[str, Any] = {
        "format": FORMAT,
        "language": words.language,
        "title": inputs.site.report.title or words("page.title"),
        "company": inputs.site.report.company,
        "version": inputs.versions.get("gradetrace", words("page.unknown")),
        "units": {"length": units.length, "deviation": units.deviation},
        "verdict": facts.verdict_of(inputs, words),
        "surveyed": facts.surveyed(inputs, units, words),
        "summary": facts.summary(inputs, units, words, statistics),
        "attention": attention(inputs, units, words, timeline, statistics),
        "stations": main,
        "stations_beyond": beyond,
        "cells": None if grid is None else measured.cells_table(inputs, grid, units, words),
        "cross_sections": measured.sections_table(sections, units, words) if sections else None,
        "wanted": quantities.wanted_shots(inputs, units, words),
        "quantities": quantities.quantities(inputs, units, words),
        "sides": quantities.sides_table(inputs, units, words),
        "checks": None if checks is None else measured.checks_table(checks, units, words),
        "check_kinds": causes.kinds_table(inputs, units, words),
        "diagnosis": causes.diagnosis(inputs, units, words),
        "utilities": utilities.section(inputs, units, words),
        "check_statistics": _labelled_statistics(statistics, words),
        "no_statistics": "" if statistics is not None else no_statistics(inputs, words),
        "indicative": statistics is not None and statistics["n"]["value"] < ENOUGH,
        "error_budget": evidence.error_budget(inputs, units, words),
        "error_budget_by_class": evidence.budget_by_class(inputs, units, words),
        "error_budget_by_station": evidence.budget_by_station(inputs, units, words),
        "coverage": evidence.coverage(inputs, words),
        "detector": {"rejected": detector.rejected(inputs, words), **detector.scatter(inputs, words)},
        "quality": evidence.quality(inputs, words),
        "consistency": consistency(inputs, words),
        "points": maps.points_table(inputs, units, words),
        **evidence.statics(inputs, words),
        "method": method(inputs, units, words),
        "provenance": provenance(inputs, words),
        "identity": identity(inputs, units),
        "settings": settings(inputs),
    }
    content["missing"] = {
        name: words("page.not_available", why=inputs.why_missing(name))
        for name in ("stations", "as_built", "checks", "residuals", "statics", "frames", "solution.json")
    }
    shots, cells = _histograms(inputs, grid, units)
    content["check_residuals"] = shots and histograms.check_residuals_table(shots, words)
    content["cell_deviations"] = cells and histograms.cell_deviations_table(cells, units, words)
    pictures, content["figures"] = _figures(inputs, units, words, grid, timeline, sections)
    content["evidence"], frames, about = views.evidence(inputs, units, words)
    content["figures"] |= about
    return content, pictures | frames


def _histograms(
    inputs: ReportInputs, grid: measured.Grid | None, units: Units
) -> tuple[histograms.Histogram | None, histograms.Histogram | None]:
    """Of the check shots and of the cells."""
    cells = None if grid is None else histograms.cell_deviations(inputs, grid, units)
    return histograms.check_residuals(inputs), cells


def _exports(inputs: ReportInputs, units: Units, words: Words) -> dict[str, dict[str, Any]]:
    found = {}
    if (stations := inputs.table("stations")) is not None:
        found["stations"] = measured.stations_table(stations, units, words, whole=True)
    if (checks := inputs.table("checks")) is not None:
        found["checks"] = measured.checks_table(checks, units, words, whole=True)
    if (points := points_table(inputs, units, words)) is not None:
        found[AS_BUILT_POINTS] = points
    return found


def _labelled_statistics(statistics, words: Words) -> list[dict[str, Any]] | None:
    if statistics is None:
        return None
    return [{"key": k, "label": words(f"statistics.{k}"), "number": v} for k, v in statistics.items()]


def _figures(
    inputs: ReportInputs,
    units: Units,
    words: Words,
    grid: measured.Grid | None,
    timeline: Timeline | None,
    sections: list[measured.Section],
) -> tuple[dict[str, str], dict[str, dict[str, str]]]:
    """SVG by name, and title, sentence and description of every figure, drawn or not."""
    pictures: dict[str, str] = {}
    about: dict[str, dict[str, str]] = {}
    stations, checks = inputs.table("stations"), inputs.table("checks")

    def add(name: str, missing: str, draw: Callable[[], Figure] | None, **places: Any) -> None:
        key = f"figures.{name}"
        about[name] = {
            "title": words(f"{key}.title"),
            "good": words(f"{key}.good"),
            "description": "",
            "why": "",
        }
        if draw is None:
            about[name]["why"] = words("page.not_available", why=inputs.why_missing(missing))
            return
        about[name]["description"] = words(f"{key}.description", **places)
        figure = draw()
        pictures[name] = svg_of(figure, f"figure-{name}", about[name]["title"], about[name]["description"])

    with house_style():
        line = inputs.alignment
        if grid is not None and line is not None:
            cut = grid.station[(np.isfinite(grid.values["h"]) & grid.values["floor"]).any(axis=0)]
            ends = (cut[0], cut[-1]) if len(cut) else (grid.station[0], grid.station[-1])
            add(
                "plan",
                "",
                lambda: maps.plan(inputs, line, grid, units),
                checks=0 if checks is None else len(checks["point"]),
                benchmarks=len(inputs.site.benchmarks),
                first=facts.station_text(ends[0], units),
                last=facts.station_text(ends[1], units),
            )
        else:
            add("plan", "as_built" if grid is None else "alignment", None)
        if stations is not None:
            dug = stations["deviation"][np.isfinite(stations["deviation"])]
            add(
                "long_section",
                "",
                lambda: profiles.long_section(inputs, stations, grid, units),
                low=facts.deviation_text(dug.min() if len(dug) else None, units),
                high=facts.deviation_text(dug.max() if len(dug) else None, units),
            )
        else:
            add("long_section", "stations", None)
        if sections:
            add(
                "cross_sections",
                "",
                lambda: profiles.cross_sections(inputs, sections, units),
                n=len(sections),
            )
        else:
            add("cross_sections", "as_built", None)
        outward = None if (told := inputs.table("sides")) is None else told["outward"]
        if told is not None and outward is not None and np.isfinite(outward).any():
            known = np.isfinite(outward)
            add(
                "sides",
                "",
                lambda: profiles.sides(inputs, told, units),
                n=len(np.unique(told["station"][known])),
                low=facts.deviation_text(outward[known].min(), units),
                high=facts.deviation_text(outward[known].max(), units),
            )
        else:
            add("sides", "sides", None)
        if grid is not None:
            count = {
                name: int((grid.values["floor"] & (grid.values["state"] == name)).sum())
                for name in ("cut", "passed over", "never touched")
            }
            add(
                "deviation_map",
                "",
                lambda: maps.deviation_map(inputs, grid, units),
                cut=count["cut"],
                passed=count["passed over"],
                never=count["never touched"],
            )
        else:
            add("deviation_map", "as_built", None)
        if utilities.lines_of(inputs):
            add(
                "utilities",
                "",
                lambda: utilities.distances(inputs, units, words),
                text=utilities.described(inputs, units, words),
            )
        compared = 0 if checks is None else int(measured.counted(checks).sum())
        if checks is not None and compared:
            add("checks", "", lambda: profiles.check_shots(checks, units), n=compared)
        else:
            add("checks", "checks", None)
        parts = evidence.budget_parts(inputs, words)
        text = ", ".join(
            f"{name} {facts.deviation_number(v, units, False, True)['value']}" for name, v in parts
        )
        add(
            "error_budget",
            "solution.json",
            (lambda: charts.error_budget(parts, units)) if parts else None,
            text=f"{text} {units.deviation}",
        )
        if timeline is not None:
            add(
                "coverage",
                "",
                lambda: charts.coverage(timeline),
                cameras=len(timeline.frames),
                gaps=len(timeline.gaps_ns),
                seconds=numbers.duration_text(timeline.bridged_s),
                spells=len(timeline.idle_ns),
                idle=numbers.duration_text(timeline.idle_s),
            )
        else:
            add("coverage", "frames", None)
        tags = detector.points(inputs)
        add(
            "pixel_noise",
            "detection.json",
            (lambda: charts.pixel_noise(tags)) if tags else None,
            n=sum(len(points) for points in tags.values()),
            text=", ".join(f"{camera} {len(points)}" for camera, points in tags.items()),
        )
        if inputs.detection and not tags:
            about["pixel_noise"]["why"] = words("page.not_available", why=words("detector.none"))
        histogram = evidence.residual_histogram(inputs)
        if histogram is not None:
            length = inputs.tables["residuals"]["normalised"]
            add(
                "residuals",
                "",
                lambda: charts.residuals(*histogram),
                n=len(length),
                beyond=text_of(100 * float(np.mean(length > evidence.FAR)), 1),
            )
        else:
            add("residuals", "residuals", None)
        shots, cells = _histograms(inputs, grid, units)
        add(
            "check_residuals",
            "checks",
            (lambda: charts.check_residuals(shots)) if shots else None,
            n=0 if shots is None else int(shots.count.sum()),
        )
        tolerance = inputs.site.tolerance
        high, low = tolerance.high_mm / 1000, tolerance.low_mm / 1000
        band = (-float(units.to_deviation(low)), float(units.to_deviation(high)))
        add(
            "cell_deviations",
            "as_built",
            (lambda: charts.cell_deviations(cells, band, units)) if cells else None,
            n=0 if cells is None else int(cells.count.sum()),
            low=facts.deviation_text(-low, units, fine=True),
            high=facts.deviation_text(high, units, fine=True),
        )
        limit = (high + low) / 2 / tolerance.coverage_factor
        add(
            "uncertainty",
            "stations",
            (lambda: charts.uncertainty(stations, limit, units)) if stations is not None else None,
            own=facts.deviation_text(_median(stations, "sigma_own"), units, signed=False, fine=True),
            common=facts.deviation_text(_median(stations, "sigma_common"), units, signed=False, fine=True),
            limit=facts.deviation_text(limit, units, signed=False, fine=True),
        )
    return pictures, about


def _median(stations: Table | None, name: str) -> float | None:
    """Of a column of the stations that were dug; None without any."""
    known = np.zeros(0) if stations is None else stations[name][np.isfinite(stations[name])]
    return float(np.median(known)) if len(known) else None
