"""`gradetrace survey`: benchmarks of site.toml from a surveyor's file of their corners, with a sheet."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration.corner_survey import CORNER_NAMES, MarkerPose, SurveyedMarker, marker_pose
from pipeline.config import Site, load_site
from pipeline.config.document import decode, read_file
from pipeline.config.quantities import Print
from pipeline.errors import CalibrationError
from pipeline.geometry import so3
from pipeline.report.survey_sheet import survey_sheet
from pipeline.stages.calibrated import (
    Written,
    demand_of,
    provenance,
    put_into,
    refuse_read_only,
    written_covariance,
)
from pipeline.surface.shots import Shots, read_shots

COMMAND = "gradetrace survey"
_CORNER = re.compile(r"(?:(?P<tag>\d+)[-_./ :])?(?P<corner>TL|TR|BR|BL|[0-3])", re.IGNORECASE)
_OUTER = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])


def run(
    file: Path,
    site: Path,
    order: str = "PNEZD",
    sigma_mm: float = 2.0,
    layout: Mapping[str, str] | None = None,
    station: tuple[float, float, float] | None = None,
    date: datetime.date | None = None,
    distance_m: float = 8.0,
) -> Written:
    """Write the poses of surveyed markers into site.toml.

    Parameters
    ----------
    file : Path
        Shots, as check shots are read; ids such as BM1-TL (outer corner of the whole print) or BM1-17-TL (of tag 17).
    site : Path
        site.toml with the prints of the markers.
    order : str
        PNEZD, PENZD or named.
    sigma_mm : float
        Of each coordinate where the file has no column of its own.
    layout : mapping, optional
        Point id -> id of the form above.
    station : 3 floats, optional
        Easting, northing, elevation of the instrument, grid unit: prints face it.
    date : datetime.date, optional
        Of the survey; else the day the file was last changed.
    distance_m : float
        From the markers to the work, for the line that says whether they are good enough.

    Raises
    ------
    PipelineError
        Nothing is written then.
    """
    model = load_site(decode(read_file(site), str(site)), str(site))
    refuse_read_only(site)
    if not file.is_file():
        raise CalibrationError(f"{file}: no such file; name the surveyor's file of corners")
    shots = read_shots(file, order, model.grid.metres_per_unit)
    markers = surveyed_markers(shots, model, file.name, sigma_mm / 1000, layout or {}, station)
    poses = [marker_pose(marker) for marker in markers]
    day = date or datetime.datetime.fromtimestamp(file.stat().st_mtime, datetime.UTC).date()
    stamp = provenance(day, COMMAND, file)
    sheet = survey_sheet(
        poses,
        markers,
        demand_of(model, distance_m),
        subject=model.site.id,
        origin={file.name: f"sha256 {stamp['sha256'][:12]}", "surveyed": day.isoformat()},
    )
    values: dict[str, Any] = {}
    for pose in poses:
        values[f"benchmarks.{pose.name}.corners"] = None
        values[f"benchmarks.{pose.name}.sigma_corner_mm"] = None
        values[f"benchmarks.{pose.name}.pose"] = _pose_table(pose, model, stamp)
    page = site.with_name(f"{file.stem}-survey.html")
    kept = put_into(site, "site", values, sheet, page)
    return Written(sheet.sentence, tuple(sheet.remarks), page, site, kept)


def surveyed_markers(
    shots: Shots,
    site: Site,
    source: str,
    sigma_m: float,
    layout: Mapping[str, str],
    station: tuple[float, float, float] | None,
) -> list[SurveyedMarker]:
    """The markers of site.toml whose corners stand in a file.

    Raises
    ------
    CalibrationError
        A point names no marker, no corner, or a corner twice; none names any.
    """
    p_world = shots.p_grid - np.array(site.grid.origin) * site.grid.metres_per_unit
    found: dict[str, dict[str, tuple[np.ndarray, np.ndarray, float]]] = {}
    unread = []
    for k, point in enumerate(shots.point):
        named = layout.get(str(point), str(point))
        read = _corner_of(named, site)
        if read is None:
            if str(point) in layout:
                raise CalibrationError(
                    f"{source}: '{named}', as point {point} is said to be, is no corner of a marker of site.toml; "
                    f"write such as {_example(site)}"
                )
            unread.append(str(point))
            continue
        name, p = read
        corners = found.setdefault(name, {})
        label = str(point)
        if any(np.allclose(p, other) for other, _, _ in corners.values()):
            raise CalibrationError(f"{source}: point {point} is a corner of '{name}' that was shot already")
        sigma = float(shots.sigma_m[k])
        corners[label] = p, p_world[k], sigma if np.isfinite(sigma) else sigma_m
    if not found:
        raise CalibrationError(
            f"{source}: no point is named after a corner of a marker of site.toml; write ids such as {_example(site)}, "
            f"or say with --layout what they are (the first is '{unread[0] if unread else ''}')"
        )
    markers = []
    for name, corners in found.items():
        rows = list(corners.values())
        marker = SurveyedMarker(
            name,
            tuple(corners),
            np.array([p for p, _, _ in rows]),
            np.array([q for _, q, _ in rows]),
            np.array([s for _, _, s in rows]),
        )
        markers.append(replace(marker, faces=_seen_from(site, station)))
    return markers


def _seen_from(site: Site, station: tuple[float, float, float] | None) -> np.ndarray | None:
    """World point that prints face: only the instrument's is known to be before them all."""
    return None if station is None else site.grid.to_world(np.array(station))


def _corner_of(named: str, site: Site) -> tuple[str, np.ndarray] | None:
    """The marker and the (3,) place on its print of a point's id; None where it is no such id."""
    for name in sorted(site.benchmarks, key=len, reverse=True):
        if not named.lower().startswith(name.lower()):
            continue
        match = _CORNER.fullmatch(named[len(name) :].lstrip("-_./ :"))
        if match is None:
            continue
        corner = match["corner"].upper()
        number = CORNER_NAMES.index(corner) if corner in CORNER_NAMES else int(corner)
        mark = site.benchmarks[name]
        if match["tag"] is None:
            return name, outer_corner(mark, number)
        tags = {tag.id: tag for tag in mark.tags}
        if int(match["tag"]) in tags:
            return name, tags[int(match["tag"])].corners()[number]
    return None


def outer_corner(mark: Print, number: int) -> np.ndarray:
    """(3,) the corner of a print's tags that lies furthest out: 0..3 are TL, TR, BR, BL."""
    corners = np.concatenate([tag.corners() for tag in mark.tags])
    return np.asarray(corners[np.argmax(corners[:, :2] @ _OUTER[number])])


def _example(site: Site) -> str:
    name = next(iter(site.benchmarks), "BM1")
    return f"{name}-TL, {name}-TR, {name}-BR"


def _pose_table(pose: MarkerPose, site: Site, stamp: Mapping[str, object]) -> dict[str, object]:
    T = pose.T_world_marker
    enh = np.array(site.grid.origin) + T[:3, 3] / site.grid.metres_per_unit
    return {
        "enh": enh,
        "rpy_deg": so3.to_rpy_deg(T[:3, :3]),
        "covariance": written_covariance(pose.covariance),
        "calibrated": dict(stamp),
    }
