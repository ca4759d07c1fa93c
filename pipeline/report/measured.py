"""What was measured, as tables: stations, check shots and their statistics, cross sections, cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.facts import deviation_number
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.moments import worst_rows
from pipeline.report.numbers import column, number
from pipeline.report.units import Units
from pipeline.report.words import Words
from pipeline.surface.design import Design
from pipeline.tables import NULL_INT

BESIDE_FLOOR_M = 0.3
"""Figures show this much beside the floor: what the edge touched further out says nothing on the trench."""
MAX_REGULAR_SECTIONS = 9
_PLAN = ("difference_e", "difference_n", "sigma_e", "sigma_n")


def stations_table(stations: Table, units: Units, words: Words, whole: bool = False) -> dict[str, Any]:
    """The station table of the page; `whole` for the export: with the reason of every station."""
    length, fall = units.length, units.deviation
    columns = [
        column("station", words("columns.station"), length, units.station_digits),
        column("verdict", words("columns.verdict"), kind="judged"),
        column("deviation", words("columns.deviation"), fall, units.deviation_digits, signed=True),
        column("u", words("columns.u"), fall, units.deviation_digits),
        column("h", words("columns.h"), length, units.length_digits),
        column("design_h", words("columns.design_h"), length, units.length_digits),
        column("sigma_own", words("columns.sigma_own"), fall, units.fine_digits),
        column("sigma_common", words("columns.sigma_common"), fall, units.fine_digits),
        column("width", words("columns.width"), length, units.station_digits),
        column("covered", words("columns.covered"), "%", 0),
        *([column("state", words("columns.state"))] if whole else []),
        column("reason", words("columns.reason"), kind="why"),
    ]
    floor = np.asarray(stations["cells_floor"], float)
    # Two hundred times "lies inside the tolerance" would hide the reasons that matter.
    plain_pass = ~np.full(len(floor), whole) & (stations["verdict"] == "PASS") & (stations["state"] == "cut")
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
            "reason": np.where(plain_pass, "", stations["reason"]),
        }
    )
    return numbers.table(columns, rows)


def split_stations(
    stations: Table, units: Units, words: Words
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The station table from the first to the last station that was dug, and the rest, or None.

    Sixty rows of "not reached" before and after a morning's work would bury it.
    """
    everything = stations_table(stations, units, words)
    dug = np.flatnonzero(np.isfinite(stations["deviation"]))
    if len(dug) == 0:
        return everything, None
    first, last = dug[0], dug[-1] + 1
    rows = everything["rows"]
    beyond = {"columns": everything["columns"], "rows": rows[:first] + rows[last:]}
    return {"columns": everything["columns"], "rows": rows[first:last]}, beyond if beyond["rows"] else None


def checks_table(checks: Table, units: Units, words: Words, whole: bool = False) -> dict[str, Any]:
    """The check-shot table of the page; `whole` for the export: with all for which paper has no room."""
    length, fall, fine = units.length, units.deviation, units.fine_digits
    columns = [
        column("point", words("columns.point"), kind="id"),
        column("code", words("columns.code"), kind="id"),
        *(
            [column("kind", words("columns.check_kind"))]
            if whole or np.any(checks["kind"] != "floor")
            else []
        ),
        column("station", words("columns.station"), length, units.station_digits),
        column("offset", words("columns.offset"), length, units.station_digits, signed=True),
        column("h", words("columns.shot_h"), length, units.length_digits),
        column("as_built_h", words("columns.h"), length, units.length_digits),
        column("difference", words("columns.difference"), fall, fine, signed=True),
        column("sigma_own", words("columns.sigma_own"), fall, fine),
        column("sigma_common", words("columns.sigma_common"), fall, fine),
        column("sigma_ts", words("columns.sigma_ts"), fall, fine),
        column("z", words("columns.z"), "", 1, signed=True),
        column("result", words("columns.result")),
    ]
    if whole:
        columns += [column(key, words(f"columns.{key}"), length, units.length_digits) for key in ("e", "n")]
        columns += [column(key, words(f"columns.{key}")) for key in ("edge_point", "time")]
        columns += [column(key, words(f"columns.{key}"), fall, fine, signed=True) for key in _PLAN[:2]]
        columns += [column(key, words(f"columns.{key}"), fall, fine) for key in ("sigma", *_PLAN[2:])]
    shown: dict[str, Any] = {key: checks[key] for key in ("point", "code", "edge_point", "z", "result")}
    shown["kind"] = [words(f"check_kinds.{kind}") for kind in checks["kind"]]
    shown["time"] = ["" if t == NULL_INT else numbers.utc_text(t, 1) for t in checks["time_ns"].tolist()]
    shown |= {key: units.to_length(checks[key]) for key in ("station", "offset", "h", "as_built_h", "e", "n")}
    falls = ("difference", "sigma", "sigma_own", "sigma_common", "sigma_ts", *_PLAN)
    shown |= {key: units.to_deviation(checks[key]) for key in falls}
    return numbers.table(columns, numbers.records(shown))


def counted(checks: Table, kind: str | None = "floor") -> np.ndarray:
    """(n,) bool: the shots of a kind, or of all, that the statistics are made of."""
    compared = np.asarray(checks["result"]) == "compared"
    return compared if kind is None else compared & (np.asarray(checks["kind"]) == kind)


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
    if checks is not None and counted(checks).any():
        z = checks["z"][counted(checks)]
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
    """Column -> (m, n); NaN, or ``never touched``, where the table has no such cell. And ``floor``, bool."""

    @property
    def cell_m(self) -> tuple[float, float]:
        """Size of a cell along station and offset."""
        return _step(self.station), _step(self.offset)


def grid_of(as_built: Table, design: Design | None = None) -> Grid | None:
    """The cells on and beside the floor laid out as an image; None where there are none.

    Without a design every cell is taken to be floor.
    """
    station, offset = np.asarray(as_built["station"], float), np.asarray(as_built["offset"], float)
    floor = np.ones(len(station), bool) if design is None else design.is_floor(station, offset)
    if not floor.any():
        return None
    reach = np.array([offset[floor].min(), offset[floor].max()]) + [-BESIDE_FLOOR_M, BESIDE_FLOOR_M]
    keep = (offset >= reach[0]) & (offset <= reach[1])
    keep &= (station >= station[floor].min()) & (station <= station[floor].max())
    stations, at = np.unique(np.round(station[keep], 6), return_inverse=True)
    offsets, row = np.unique(np.round(offset[keep], 6), return_inverse=True)
    # Stations where nothing was ever near leave no cells; without this the image would close that gap.
    step = _step(stations)
    full = stations[0] + step * np.arange(round((stations[-1] - stations[0]) / step) + 1)
    at = np.round((stations[at] - stations[0]) / step).astype(int)
    values: dict[str, np.ndarray] = {}
    for name in ("h", "design_h", "deviation", "sigma_own", "sigma_common"):
        image = np.full((len(offsets), len(full)), np.nan)
        image[row, at] = as_built[name][keep]
        values[name] = image
    state = np.full((len(offsets), len(full)), "never touched", dtype=object)
    state[row, at] = as_built["state"][keep]
    values["state"] = state
    on_floor = np.zeros((len(offsets), len(full)), bool)
    on_floor[row, at] = floor[keep]
    values["floor"] = on_floor & np.isfinite(values["design_h"])
    return Grid(full, offsets, values)


def _step(centres: np.ndarray) -> float:
    return float(np.median(np.diff(centres))) if len(centres) > 1 else 0.05


@dataclass(frozen=True)
class Section:
    """One cross section: the cells that touch one station."""

    station: float
    why: str
    """``regular`` or ``worst``."""
    offset: np.ndarray
    h: np.ndarray
    design_h: np.ndarray
    sigma: np.ndarray
    floor: np.ndarray
    """Which of the offsets are on the floor."""


def sections_of(inputs: ReportInputs, grid: Grid) -> list[Section]:
    """Regular cross sections, at most nine, and those of the three worst stations, by station."""
    stations = inputs.table("stations")
    cut = grid.station[(np.isfinite(grid.values["h"]) & grid.values["floor"]).any(axis=0)]
    if len(cut) == 0:
        return []
    step = inputs.site.report.cross_section_step_m
    regular = np.arange(np.ceil(cut[0] / step) * step, cut[-1] + 1e-9, step)
    if len(regular) == 0:
        regular = np.array([(cut[0] + cut[-1]) / 2])
    if len(regular) > MAX_REGULAR_SECTIONS:
        regular = regular[np.linspace(0, len(regular) - 1, MAX_REGULAR_SECTIONS).round().astype(int)]
    wanted = {round(float(station), 6): "regular" for station in regular}
    if stations is not None:
        worst = stations["station"][worst_rows(stations)]
        wanted |= {round(float(station), 6): "worst" for station in worst}
    sections = [_section(grid, station, why, inputs.design) for station, why in sorted(wanted.items())]
    return [section for section in sections if np.isfinite(section.h[section.floor]).any()]


def _section(grid: Grid, station: float, why: str, design: Design | None) -> Section:
    """The mean of the cells that touch a station, which lies as often on their border as inside one."""
    near = np.abs(grid.station - station) <= grid.cell_m[0] * (0.5 + 1e-6)
    means = {}
    for name in ("h", "design_h", "sigma_own", "sigma_common"):
        part = grid.values[name][:, near]
        known = np.isfinite(part)
        count = known.sum(axis=1)
        means[name] = np.where(
            count > 0, np.where(known, part, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan
        )
    sigma = np.hypot(means["sigma_own"], means["sigma_common"])
    if design is not None:
        means["design_h"] = design.elevation(np.full(len(grid.offset), station), grid.offset)
    floor = np.any(grid.values["floor"][:, near], axis=1)
    assert isinstance(floor, np.ndarray)
    return Section(station, why, grid.offset, means["h"], means["design_h"], sigma, floor)


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
    step = inputs.site.station_step_m
    block = np.floor((grid.station - grid.station[0]) / step + 1e-6).astype(int)
    rows = []
    for number_ in np.unique(block):
        part = grid.values["deviation"][:, block == number_]
        known = part[np.isfinite(part) & grid.values["floor"][:, block == number_]]
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
