"""What was measured, as tables: stations, check shots and their statistics, cross sections, cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.facts import deviation_number
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.numbers import column, number
from pipeline.report.units import Units
from pipeline.report.words import Words

MAX_REGULAR_SECTIONS = 9
WORST_SECTIONS = 3
INDICATIVE_BELOW = 30
"""Fewer check shots than this carry no accuracy statement, only an indication."""


def stations_table(stations: Table, units: Units, words: Words) -> dict[str, Any]:
    """The station table of the page."""
    length, fall = units.length, units.deviation
    columns = [
        column("station", words("columns.station"), length, units.station_digits),
        column("verdict", words("columns.verdict"), kind="verdict"),
        column("deviation", words("columns.deviation"), fall, units.deviation_digits, signed=True),
        column("u", words("columns.u"), fall, units.deviation_digits),
        column("h", words("columns.h"), length, units.length_digits),
        column("design_h", words("columns.design_h"), length, units.length_digits),
        column("sigma_own", words("columns.sigma_own"), fall, units.fine_digits),
        column("sigma_common", words("columns.sigma_common"), fall, units.fine_digits),
        column("width", words("columns.width"), length, units.station_digits),
        column("covered", words("columns.covered"), "%", 0),
        column("state", words("columns.state")),
        column("reason", words("columns.reason")),
    ]
    floor = np.asarray(stations["cells_floor"], float)
    rows = numbers.records(
        {
            "station": units.to_length(stations["station"]),
            "verdict": stations["verdict"],
            "deviation": units.to_deviation(stations["deviation"]),
            "u": units.to_deviation(stations["expanded_uncertainty"]),
            "h": units.to_length(stations["h"]),
            "design_h": units.to_length(stations["design_h"]),
            "sigma_own": units.to_deviation(stations["sigma_own"]),
            "sigma_common": units.to_deviation(stations["sigma_common"]),
            "width": units.to_length(stations["width"]),
            "covered": 100.0 * np.asarray(stations["cells_cut"], float) / np.where(floor > 0, floor, np.nan),
            "state": stations["state"],
            "reason": stations["reason"],
        }
    )
    return numbers.table(columns, rows)


def checks_table(checks: Table, units: Units, words: Words) -> dict[str, Any]:
    """The check-shot table of the page."""
    length, fall, fine = units.length, units.deviation, units.fine_digits
    columns = [
        column("point", words("columns.point"), kind="name"),
        column("code", words("columns.code"), kind="name"),
        column("station", words("columns.station"), length, units.station_digits),
        column("offset", words("columns.offset"), length, units.station_digits, signed=True),
        column("h", words("columns.shot_h"), length, units.length_digits),
        column("as_built_h", words("columns.h"), length, units.length_digits),
        column("difference", words("columns.difference"), fall, fine, signed=True),
        column("sigma", words("columns.sigma"), fall, fine),
        column("sigma_ts", words("columns.sigma_ts"), fall, fine),
        column("z", words("columns.z"), "", 1, signed=True),
        column("result", words("columns.result")),
        column("e", words("columns.e"), length, units.length_digits),
        column("n", words("columns.n"), length, units.length_digits),
    ]
    shown = {key: checks[key] for key in ("point", "code", "z", "result")}
    shown |= {key: units.to_length(checks[key]) for key in ("station", "offset", "h", "as_built_h", "e", "n")}
    shown |= {key: units.to_deviation(checks[key]) for key in ("difference", "sigma", "sigma_ts")}
    return numbers.table(columns, numbers.records(shown))


def check_statistics(inputs: ReportInputs, units: Units) -> dict[str, numbers.Number] | None:
    """Statistics of the compared shots as the survey stage found them, or None without such a shot."""
    found = inputs.survey.get("checks") or {}
    if not found.get("n"):
        return None
    shown = {"n": number(int(found["n"]))}
    for key, signed in (("bias", True), ("rmse", False), ("worst", True)):
        shown[key] = deviation_number(found.get(key), units, signed, fine=True)
    shown["reduced_chi_square"] = number(found.get("reduced_chi_square"), "", 2)
    checks = inputs.table("checks")
    if checks is not None and np.isfinite(checks["z"]).any():
        z = checks["z"][np.isfinite(checks["z"])]
        shown["within"] = number(100.0 * float(np.mean(np.abs(z) <= 2.0)), "%", 0)
    return shown


@dataclass(frozen=True)
class Grid:
    """The as-built cells as an image: rows run along the offset, columns along the station."""

    station: np.ndarray
    """(n,) centres, metres."""
    offset: np.ndarray
    """(m,) centres, metres, right of the alignment positive."""
    values: dict[str, np.ndarray]
    """Column -> (m, n); NaN (or an empty string) where the table has no such cell."""

    @property
    def cell_m(self) -> tuple[float, float]:
        """Size of a cell along station and offset."""
        return _step(self.station), _step(self.offset)


def grid_of(as_built: Table) -> Grid:
    """The cells laid out as an image."""
    station, at = np.unique(np.round(as_built["station"], 6), return_inverse=True)
    offset, row = np.unique(np.round(as_built["offset"], 6), return_inverse=True)
    # Stations where nothing was ever near leave no cells; without this the image would close that gap.
    step = _step(station)
    full = station[0] + step * np.arange(round((station[-1] - station[0]) / step) + 1)
    at = np.round((station[at] - station[0]) / step).astype(int)
    values: dict[str, np.ndarray] = {}
    for name in ("h", "design_h", "deviation", "sigma_own", "sigma_common"):
        image = np.full((len(offset), len(full)), np.nan)
        image[row, at] = as_built[name]
        values[name] = image
    state = np.full((len(offset), len(full)), "never touched", dtype=object)
    state[row, at] = as_built["state"]
    values["state"] = state
    return Grid(full, offset, values)


def _step(centres: np.ndarray) -> float:
    return float(np.median(np.diff(centres))) if len(centres) > 1 else 0.05


@dataclass(frozen=True)
class Section:
    """One cross section: the cells of one station, mean over the cells of the station's length."""

    station: float
    why: str
    """``regular`` or ``worst``."""
    offset: np.ndarray
    h: np.ndarray
    design_h: np.ndarray
    sigma: np.ndarray


def sections_of(inputs: ReportInputs, grid: Grid) -> list[Section]:
    """Regular cross sections, at most nine, and those of the three worst stations, by station."""
    stations = inputs.table("stations")
    columns: dict[int, str] = {}
    cut = np.flatnonzero(np.isfinite(grid.values["h"]).any(axis=0))
    if len(cut) == 0:
        return []
    step = inputs.site.report.cross_section_step_m
    first, last = grid.station[cut[0]], grid.station[cut[-1]]
    wanted = np.arange(np.ceil(first / step) * step, last + 1e-9, step)
    if len(wanted) == 0:
        wanted = np.array([(first + last) / 2])
    if len(wanted) > MAX_REGULAR_SECTIONS:
        wanted = wanted[np.linspace(0, len(wanted) - 1, MAX_REGULAR_SECTIONS).round().astype(int)]
    for station in wanted:
        columns.setdefault(int(cut[np.argmin(np.abs(grid.station[cut] - station))]), "regular")
    if stations is not None:
        dug = np.flatnonzero(np.isfinite(stations["deviation"]))
        worst = dug[np.argsort(-np.abs(stations["deviation"][dug]), kind="stable")][:WORST_SECTIONS]
        for station in stations["station"][worst]:
            columns[int(cut[np.argmin(np.abs(grid.station[cut] - station))])] = "worst"
    sections = []
    for at, why in sorted(columns.items()):
        values = {name: grid.values[name][:, at] for name in ("h", "design_h", "sigma_own", "sigma_common")}
        sections.append(
            Section(
                float(grid.station[at]),
                why,
                grid.offset,
                values["h"],
                values["design_h"],
                np.hypot(values["sigma_own"], values["sigma_common"]),
            )
        )
    return sections


def sections_table(sections: list[Section], units: Units, words: Words) -> dict[str, Any]:
    """Every point of the cross sections that has an elevation."""
    columns = [
        column("station", words("columns.station"), units.length, units.station_digits),
        column("section", words("columns.section")),
        column("offset", words("columns.offset"), units.length, 3, signed=True),
        column("h", words("columns.h"), units.length, units.length_digits),
        column("design_h", words("columns.design_h"), units.length, units.length_digits),
        column("deviation", words("columns.deviation"), units.deviation, units.deviation_digits, signed=True),
        column("sigma", words("columns.sigma"), units.deviation, units.fine_digits),
    ]
    rows = []
    for section in sections:
        for i in np.flatnonzero(np.isfinite(section.h)):
            rows.append(
                {
                    "station": units.to_length(section.station),
                    "section": section.why,
                    "offset": units.to_length(section.offset[i]),
                    "h": units.to_length(section.h[i]),
                    "design_h": units.to_length(section.design_h[i]),
                    "deviation": units.to_deviation(section.h[i] - section.design_h[i]),
                    "sigma": units.to_deviation(section.sigma[i]),
                }
            )
    return numbers.table(columns, rows)


def cells_table(inputs: ReportInputs, grid: Grid, units: Units, words: Words) -> dict[str, Any]:
    """The deviation map in figures: lowest, mean and highest cell of each station's length."""
    columns = [
        column("station", words("columns.station"), units.length, units.station_digits),
        column("cells", words("columns.cells"), "", 0),
        column("low", words("columns.low"), units.deviation, units.deviation_digits, signed=True),
        column("mean", words("columns.deviation"), units.deviation, units.deviation_digits, signed=True),
        column("high", words("columns.high"), units.deviation, units.deviation_digits, signed=True),
    ]
    step = inputs.site.survey.station_step_m
    block = np.floor((grid.station - grid.station[0]) / step + 1e-6).astype(int)
    rows = []
    for number_ in np.unique(block):
        part = grid.values["deviation"][:, block == number_]
        known = part[np.isfinite(part)]
        low, mean, high = (known.min(), known.mean(), known.max()) if len(known) else (np.nan,) * 3
        rows.append(
            {
                "station": units.to_length(grid.station[block == number_].mean()),
                "cells": len(known),
                "low": units.to_deviation(low),
                "mean": units.to_deviation(mean),
                "high": units.to_deviation(high),
            }
        )
    return numbers.table(columns, rows)
