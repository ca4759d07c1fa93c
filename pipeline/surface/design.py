"""The trench as designed: elevation and floor over station and offset, from whatever file it comes in.

What the **floor** is: for a profile or a run of pipes, everything within half the floor width of the alignment. A
triangulated surface
does not say; there the floor is made of the faces no steeper than `FLOOR_SLOPE` that hang together, edge by edge,
with such faces under the alignment. Walls, slopes and the ground beside the trench, which flat faces
cannot reach across a wall, are thereby left out. Where no face under the alignment is that flat (a ditch in the
shape of a V), the whole surface counts as floor, and the report says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import shapely

from pipeline.config.site import METRES_PER_UNIT, Site
from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment, polyline
from pipeline.surface.dxf import Drawing, check_drawing_unit, read_dxf
from pipeline.surface.landxml import LandXml, TinSurface, profile_named, read_landxml
from pipeline.surface.long_profile import long_profile
from pipeline.surface.pipe_run import run_of
from pipeline.surface.plan_geometry import alignment_of
from pipeline.surface.profile_csv import read_profile_rows

FLOOR_SLOPE = 0.2
"""Rise per run. Pipes and trench floors stay under 0.1; the flattest side slopes that are cut are 0.25 (1 in 4)."""
NEAR_M = 50_000.0
"""A design further than this from the world's origin belongs to another job, or has its axes or unit wrong."""
NEAR_ELEVATION_M = 1_000.0
_QUERY = 262_144


class Design(Protocol):
    """What the rest of the room asks of a design; stations, offsets and elevations in metres."""

    @property
    def name(self) -> str:
        """Surface or file."""

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Design elevation; nan outside the design."""

    def is_floor(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Whether a place belongs to the trench floor."""

    def floor_level(self, station: np.ndarray) -> np.ndarray:
        """Level of the floor at stations, also beside the trench; nan where there is no design."""

    def station_range(self) -> tuple[float, float]:
        """First and last station of the design on the alignment."""

    def floor_reach(self) -> float:
        """Largest distance of the floor from the alignment."""


@dataclass(frozen=True)
class ProfileDesign:
    """A trench by station: floor elevation, floor width, side slope; linear between rows."""

    name: str
    station: np.ndarray
    """(n,) ascending, metres."""
    floor: np.ndarray
    """(n,) elevation, metres."""
    width: np.ndarray
    """(n,) of the floor, centred on the alignment, metres."""
    side_slope: np.ndarray
    """(n,) run per rise; 0 is a vertical wall, and the design then ends at the foot of the wall."""

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        beyond = np.abs(offset) - 0.5 * self._at(station, self.width)
        run_per_rise = self._at(station, self.side_slope)
        sloped = run_per_rise > 0
        rise = np.where(sloped, np.maximum(beyond, 0.0) / np.where(sloped, run_per_rise, 1.0), 0.0)
        return np.where((beyond > 0) & ~sloped, np.nan, self.floor_level(station) + rise)

    def is_floor(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        return np.abs(offset) <= 0.5 * self._at(station, self.width)

    def floor_level(self, station: np.ndarray) -> np.ndarray:
        return self._at(np.asarray(station, float), self.floor)

    def station_range(self) -> tuple[float, float]:
        return float(self.station[0]), float(self.station[-1])

    def floor_reach(self) -> float:
        return 0.5 * float(self.width.max())

    def _at(self, station: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(station, self.station, values, left=np.nan, right=np.nan)


class TinDesign:
    """A triangulated surface seen along an alignment."""

    def __init__(self, name: str, points: np.ndarray, faces: np.ndarray, alignment: Alignment):
        """Surface of `points` (n, 3) in grid metres and `faces` (m, 3)."""
        self.name = name
        self.points = points
        corners = points[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        plan = np.abs(normal[:, 2])
        # Vertical faces have no plan area, so no elevation to give.
        level = plan > 1e-12 + 1e-9 * np.linalg.norm(normal, axis=1)
        self.faces = faces[level]
        self._corners = corners[level]
        self._slope = np.hypot(normal[level, 0], normal[level, 1]) / plan[level]
        self._alignment = alignment
        self._tree = shapely.STRtree(
            shapely.box(*self._corners[:, :, :2].min(axis=1).T, *self._corners[:, :, :2].max(axis=1).T)
        )
        # A surface often ends with its alignment, and rounding in the file puts the end on either side.
        first, last = alignment.start_station, alignment.end_station
        inside = min(0.001, 0.25 * alignment.length)
        self._station = np.unique(
            np.append(np.arange(first, last, 0.25), [first + inside, last - inside, last])
        )
        on_axis, face = self._find(alignment.points(self._station, 0.0))
        if not np.any(face >= 0):
            raise SurfaceError(
                f"design surface '{name}' does not lie under the alignment anywhere; "
                "mend design.surface or the alignment in site.toml"
            )
        self.floor_faces, self.floor_is_whole = _connected_floor(self.faces, self._slope, face)
        self._axis_level = self._level_along(on_axis, face)

    def elevation(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        return self.elevation_at(self._alignment.points(station, offset))

    def elevation_at(self, en: np.ndarray) -> np.ndarray:
        """Elevation (...) at easting, northing (..., 2); the lowest face where several lie above each other."""
        return self._find(en.reshape(-1, 2))[0].reshape(en.shape[:-1])

    def is_floor(self, station: np.ndarray, offset: np.ndarray) -> np.ndarray:
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        face = self._find(self._alignment.points(station, offset).reshape(-1, 2))[1]
        return np.where(face >= 0, self.floor_faces[face], False).reshape(station.shape)

    def floor_level(self, station: np.ndarray) -> np.ndarray:
        return np.interp(station, self._station, self._axis_level, left=np.nan, right=np.nan)

    def station_range(self) -> tuple[float, float]:
        there = self._station[np.isfinite(self._axis_level)]
        return float(there[0]), float(there[-1])

    def floor_reach(self) -> float:
        corners = self._corners[self.floor_faces][:, :, :2].reshape(-1, 2)
        station, offset = self._alignment.station_offset(corners)
        near = (station > self._alignment.start_station - 1) & (station < self._alignment.end_station + 1)
        return float(np.max(np.abs(offset[near]), initial=0.0))

    def _level_along(self, on_axis: np.ndarray, face: np.ndarray) -> np.ndarray:
        return np.where((face >= 0) & self.floor_faces[face], on_axis, np.nan)

    def _find(self, en: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elevation and face of points (n, 2); nan and -1 outside."""
        elevation, found = np.full(len(en), np.inf), np.full(len(en), -1)
        for begin in range(0, len(en), _QUERY):
            part = en[begin : begin + _QUERY]
            point, face = self._tree.query(shapely.points(part))
            a, b, c = (self._corners[face, i] for i in range(3))
            p = part[point]
            u, v, w = b[:, :2] - a[:, :2], c[:, :2] - a[:, :2], p - a[:, :2]
            area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
            beta = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
            gamma = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
            # A point on a shared edge must not fall between two faces for the sake of rounding.
            inside = (beta >= -1e-9) & (gamma >= -1e-9) & (beta + gamma <= 1 + 1e-9)
            h = a[:, 2] + beta * (b[:, 2] - a[:, 2]) + gamma * (c[:, 2] - a[:, 2])
            point, face, h = point[inside], face[inside], h[inside]
            # Highest first, so that the lowest is written last and stays.
            order = np.lexsort((-face, -h))
            elevation[begin + point[order]] = h[order]
            found[begin + point[order]] = face[order]
        return np.where(found >= 0, elevation, np.nan), found


def _connected_floor(faces: np.ndarray, slope: np.ndarray, on_axis: np.ndarray) -> tuple[np.ndarray, bool]:
    """(m,) bool: which faces are floor; and whether that is the whole surface for want of flat ones."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    flat = slope <= FLOOR_SLOPE
    seeds = np.unique(on_axis[on_axis >= 0])
    seeds = seeds[flat[seeds]]
    if len(seeds) == 0:
        return np.ones(len(faces), dtype=bool), True
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = np.all(edges[1:] == edges[:-1], axis=1) & flat[owner[1:]] & flat[owner[:-1]]
    one, other = owner[:-1][same], owner[1:][same]
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(faces), len(faces)))
    _, label = connected_components(graph, directed=False)
    return flat & np.isin(label, label[seeds]), False


def floor_sentence(design: Design) -> str:
    """What counts as the floor of this design, in words, for the report."""
    if not isinstance(design, TinDesign):
        return "The floor is everything within half the designed floor width of the alignment."
    if design.floor_is_whole:
        return (
            f"No face of the design surface under the alignment is flatter than {FLOOR_SLOPE:g} (rise per run), so the "
            "whole surface counts as floor."
        )
    return (
        f"The floor is made of the faces of the design surface no steeper than {FLOOR_SLOPE:g} (rise per run) that "
        "hang together with such faces under the alignment."
    )


FROM_BENCHMARKS_M = 40.0
"""No machine digs so far below, or above, the boards it sees."""


def read_design(path: Path, site: Site) -> tuple[Design, Alignment]:
    """The design and the alignment of a site, in grid metres, checked against the site's origin.

    Parameters
    ----------
    path : Path
        The file that ``design.file`` names.
    site : Site
        Its grid, alignment and design.

    Raises
    ------
    SurfaceError
        The file cannot be used, or design, alignment and origin do not belong together.
    """
    scale = site.grid.metres_per_unit
    origin_m = site.grid.to_grid_metres(np.zeros(3))
    given: Alignment | None = None
    if site.alignment is not None:
        given = polyline(np.array(site.alignment.points) * scale, site.alignment.start_station * scale)
        check_near(
            given.points(given.station, 0.0), origin_m[:2], site.grid.unit, "the alignment in site.toml"
        )
    design: Design
    if site.design.kind == "landxml":
        landxml = read_landxml(path)
        check_unit(landxml, site.grid.unit)
        design, alignment = _of_landxml(landxml, given, site)
    elif site.design.kind == "dxf":
        design, alignment = _of_drawing(path, given, site)
    else:
        assert given is not None
        design, alignment = read_profile(path, scale), given
    first, last = design.station_range()
    if last <= alignment.start_station or first >= alignment.end_station:
        raise SurfaceError(
            f"{path.name}: the design runs from station {first / scale:.2f} to {last / scale:.2f}, the alignment from "
            f"{alignment.start_station / scale:.2f} to {alignment.end_station / scale:.2f}; they do not meet: mend "
            "alignment.start_station or the stations of the design"
        )
    level = design.floor_level(np.linspace(first, last, 50))
    check_elevation(level, origin_m[2], path.name, scale)
    _check_against_benchmarks(level, site, path.name)
    return design, alignment


def _check_against_benchmarks(level: np.ndarray, site: Site, source: str) -> None:
    """Raise SurfaceError where the floor lies far from every surveyed benchmark: elevations in feet, say."""
    scale = site.grid.metres_per_unit
    surveyed = [
        point[2] * scale
        for mark in site.benchmarks.values()
        for point in ([mark.pose.enh] if mark.pose else [corner.enh for corner in mark.corners])
    ]
    floor = float(np.nanmedian(level))
    away = min((abs(floor - height) for height in surveyed), default=0.0)
    if away > FROM_BENCHMARKS_M:
        nearest = min(surveyed, key=lambda height: abs(floor - height))
        raise SurfaceError(
            f"{source}: the design floor lies at {floor / scale:.2f}, {away:.0f} m from the nearest benchmark "
            f"({nearest / scale:.2f}): one of them is in another unit or height datum; correct the elevations"
        )


def _of_landxml(landxml: LandXml, given: Alignment | None, site: Site) -> tuple[Design, Alignment]:
    """The design that the keys of site.toml name in a LandXML file, and its alignment unless one is given."""
    wanted, scale, source = site.design, site.grid.metres_per_unit, landxml.source
    alignment = given
    if alignment is None and wanted.alignment is not None:
        element = landxml.alignment(wanted.alignment)
        alignment = alignment_of(element, source, scale)
        _check_line(alignment, site, source)
        if wanted.profile is not None:
            profile = long_profile(profile_named(element, wanted.profile, source), source, scale)
            return _trench(f"{source}: profile {wanted.profile}", *profile.rows(), site), alignment
    if wanted.pipes is not None:
        run = run_of(landxml.pipes, wanted.pipes, wanted.pipe_run, scale, source)
        where = f"{source}: network '{wanted.pipes}'"
        origin_m = site.grid.to_grid_metres(np.zeros(3))
        check_near(run.ends[..., :2].reshape(-1, 2), origin_m[:2], site.grid.unit, where)
        if alignment is None:
            alignment = run.line((wanted.start_station or 0.0) * scale)
        assert wanted.width is not None and wanted.bedding is not None
        station, invert = run.rows(alignment, 0.5 * wanted.width * scale, where)
        name = f"{source}: {wanted.bedding:g} under the inverts of {wanted.pipes}"
        return _trench(name, station, invert - wanted.bedding * scale, site), alignment
    assert alignment is not None
    return tin_of(landxml.surface(wanted.surface), source, alignment, site), alignment


def _of_drawing(path: Path, given: Alignment | None, site: Site) -> tuple[Design, Alignment]:
    """The surface on a layer of a drawing, and the line on another unless an alignment is given."""
    wanted = site.design
    assert wanted.layer is not None
    drawing: Drawing = read_dxf(path, wanted.layer, wanted.alignment_layer, wanted.start_station or 0.0)
    check_drawing_unit(drawing, wanted.unit, site.grid.unit)
    alignment = given
    if alignment is None:
        assert drawing.alignment is not None
        alignment = alignment_of(drawing.alignment, drawing.source, site.grid.metres_per_unit)
        _check_line(alignment, site, drawing.source)
    return tin_of(drawing.surface, drawing.source, alignment, site), alignment


def _check_line(alignment: Alignment, site: Site, source: str) -> None:
    """Raise SurfaceError where an alignment of the design's own file lies elsewhere."""
    origin_m = site.grid.to_grid_metres(np.zeros(3))
    where = f"{source}: alignment '{alignment.name}'"
    check_near(alignment.points(alignment.station, 0.0), origin_m[:2], site.grid.unit, where)


def _trench(name: str, station: np.ndarray, floor: np.ndarray, site: Site) -> ProfileDesign:
    """A floor of the width and with the side slopes that site.toml says; stations and levels in metres."""
    assert site.design.width is not None
    each = np.ones(len(station))
    width_m = site.design.width * site.grid.metres_per_unit
    return ProfileDesign(name, station, floor, width_m * each, (site.design.side_slope or 0.0) * each)


def check_unit(landxml: LandXml, unit: str) -> None:
    """Raise SurfaceError unless the file is in the grid's unit."""
    if landxml.unit != unit:
        written = f"'{landxml.unit_as_written}'" if landxml.unit_as_written else "not stated"
        raise SurfaceError(
            f"{landxml.source}: its unit is {written}, but grid.unit in site.toml is '{unit}'; "
            "export the design in the unit of the grid, or mend grid.unit"
        )


def check_near(en: np.ndarray, origin_en: np.ndarray, unit: str, where: str) -> None:
    """Raise SurfaceError, with the likely cause, where points lie far from the world's origin; grid metres."""
    center = 0.5 * (en.min(axis=0) + en.max(axis=0))
    away = float(np.linalg.norm(center - origin_en))
    if away <= NEAR_M:
        return
    own = METRES_PER_UNIT[unit]
    cause = "is it the design of another job, or is grid.origin wrong?"
    if np.linalg.norm(center[::-1] - origin_en) <= NEAR_M:
        cause = "northing and easting look swapped: mend their order"
    else:
        for other, metres in METRES_PER_UNIT.items():
            if other != unit and np.linalg.norm(center * metres / own - origin_en) <= NEAR_M:
                cause = f"its coordinates look like '{other}': export them in '{unit}', the unit of the grid"
                break
    raise SurfaceError(
        f"{where}: lies around E {center[0] / own:.1f} N {center[1] / own:.1f}, {away / 1000:.0f} km from grid.origin "
        f"(E {origin_en[0] / own:.0f} N {origin_en[1] / own:.0f}, {unit}); {cause}"
    )


def check_elevation(level: np.ndarray, origin_h: float, source: str, scale: float) -> None:
    """Raise SurfaceError where the floor lies far above or below the world's origin; metres."""
    away = float(np.nanmedian(level)) - origin_h
    if abs(away) > NEAR_ELEVATION_M:
        raise SurfaceError(
            f"{source}: the design floor lies at {float(np.nanmedian(level)) / scale:.2f}, {abs(away):.0f} m from the "
            f"elevation of grid.origin ({origin_h / scale:.0f}); check the unit and the height datum"
        )


def tin_of(surface: TinSurface, source: str, alignment: Alignment, site: Site) -> TinDesign:
    """A surface of a file as a design in grid metres. Raises SurfaceError where it lies elsewhere."""
    points = surface.points * site.grid.metres_per_unit
    origin_m = site.grid.to_grid_metres(np.zeros(3))
    check_near(points[:, :2], origin_m[:2], site.grid.unit, f"{source}: surface '{surface.name}'")
    return TinDesign(surface.name or source, points, surface.faces, alignment)


def read_profile(path: Path, metres_per_unit: float) -> ProfileDesign:
    """A design of the columns station, elevation, width, side_slope. Raises SurfaceError with file, line and column."""
    table = read_profile_rows(path)
    metres = table[:, :3] * metres_per_unit
    return ProfileDesign(path.name, metres[:, 0], metres[:, 1], metres[:, 2], table[:, 3])
