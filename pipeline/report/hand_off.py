"""What a run hands on beside the page: the drawings' content, the points of the as-built floor, the list of files."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.facts import span_ns
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column
from pipeline.report.units import Units
from pipeline.report.words import Words
from pipeline.surface.hand_off import (
    CutCells,
    HandOff,
    Marks,
    Mesh,
    floor_points,
    mesh_of_cells,
    stretches,
)
from pipeline.surface.plan_geometry import without_spirals

AS_BUILT_POINTS = "as_built_pnezd"
LANDXML, DXF = "as_built.xml", "as_built.dxf"
CHORD_ERROR_M = 0.0005
"""Spirals are handed on as chords this close to them: few readers of either format follow spirals."""
FILES = (
    "report.json",
    "stations.csv",
    "checks.csv",
    f"{AS_BUILT_POINTS}.csv",
    LANDXML,
    DXF,
    "as_built.parquet",
    "sides.parquet",
    "volumes.parquet",
    "cutting_edge.parquet",
    "poses.parquet",
)
"""In the order in which the page lists them; each has its line in the words."""


def hand_off_of(inputs: ReportInputs, units: Units) -> HandOff | None:
    """What the drawings of a run hold; None without an alignment or an instant to date them by."""
    line, span = inputs.alignment, span_ns(inputs)
    if line is None or span is None:
        return None
    cells = cut_cells(inputs)
    stations, checks = inputs.table("stations"), inputs.table("checks")
    return HandOff(
        unit=inputs.site.grid.unit,
        metres_per_unit=inputs.site.grid.metres_per_unit,
        project=inputs.site.site.name or inputs.site.site.id,
        version=inputs.versions.get("gradetrace", ""),
        recorded_ns=span[1],
        alignment=without_spirals(line, CHORD_ERROR_M),
        surface=Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
        if cells is None
        else mesh_of_cells(cells, line),
        profile=() if stations is None else stretches(stations["station"], stations["h"]),
        stations=None if stations is None else _station_marks(stations, line, units),
        checks=None if checks is None else _check_marks(checks, units),
    )


def cut_cells(inputs: ReportInputs) -> CutCells | None:
    """The cells that were cut, or None without any."""
    table = inputs.table("as_built")
    if table is None:
        return None
    cut = (table["state"] == "cut") & np.isfinite(table["h"])
    if not cut.any():
        return None
    station, offset = (np.asarray(table[name], float)[cut] for name in ("station", "offset"))
    # Without a design every cell is taken to be floor, as on the page.
    floor = np.ones(len(station), bool) if inputs.design is None else inputs.design.is_floor(station, offset)
    return CutCells(station, offset, np.asarray(table["h"], float)[cut], floor, inputs.site.survey.cell_m)


def points_table(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Point, northing, easting, elevation and code of the as-built floor; None without any."""
    cells, stations = cut_cells(inputs), inputs.table("stations")
    if cells is None or stations is None or inputs.alignment is None:
        return None
    points = floor_points(
        cells,
        inputs.alignment,
        stations["station"],
        np.isfinite(stations["h"]),
        inputs.site.grid.metres_per_unit,
    )
    columns = [
        column("point", words("columns.point"), kind="id"),
        *(column(key, words(f"columns.{key}"), units.length, units.length_digits) for key in ("n", "e", "h")),
        column("code", words("columns.code"), kind="id"),
    ]
    easting, northing, h = units.to_length(points.p_grid).T
    return numbers.table(
        columns,
        numbers.records({"point": points.name, "n": northing, "e": easting, "h": h, "code": points.code}),
    )


def files_table(exports: Collection[str], drawings: bool, words: Words) -> dict[str, Any]:
    """The files of the hand-off by name with a line each; the page may be moved away from them, so no links."""
    written = {f"{name}.csv" for name in exports} | ({LANDXML, DXF} if drawings else set())
    columns = [column("name", words("columns.name"), kind="code"), column("holds", words("columns.holds"))]
    return numbers.table(
        columns,
        [
            {"name": name, "holds": words(f"hand_off.{name.replace('.', '_')}")}
            for name in FILES
            if name in written or not name.endswith((".csv", ".xml", ".dxf"))
        ],
    )


def _station_marks(stations, line, units: Units) -> Marks:
    """One point per station that was reached, on the alignment at the mean as-built level."""
    known = np.flatnonzero(np.isfinite(stations["h"]))
    station = stations["station"][known]
    return Marks(
        np.column_stack([line.points(station, 0.0), stations["h"][known]]),
        tuple(
            f"{units.to_length(s):.{units.station_digits}f} {_deviation(d, units)} {verdict}"
            for s, d, verdict in zip(station, stations["deviation"][known], stations["verdict"][known])
        ),
    )


def _check_marks(checks, units: Units) -> Marks:
    """Every shot with its name and, where it was compared, as-built minus total station."""
    return Marks(
        np.column_stack([checks["e"], checks["n"], checks["h"]]),
        tuple(
            f"{point} {_deviation(d, units)}" if np.isfinite(d) else str(point)
            for point, d in zip(checks["point"], checks["difference"])
        ),
    )


def _deviation(metres: float, units: Units) -> str:
    """With a plain hyphen for a minus: the fonts of drawings have no other."""
    value = round(float(units.to_deviation(metres)), units.fine_digits) + 0.0
    return f"{value:+.{units.fine_digits}f} {units.deviation}"
