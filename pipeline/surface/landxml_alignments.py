"""Alignments of a LandXML file: lines, arcs, spirals and chains in plan, and the profiles along them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from pipeline.errors import SurfaceError
from pipeline.surface.landxml_profiles import ProfileSection, XmlProfile
from pipeline.surface.landxml_section import (
    MAX_LIST_TEXT,
    MAX_TEXT,
    Place,
    PointSection,
    Section,
    place_of,
)

_VERTICES = ("Start", "End", "Center")
_LISTS = {"PntList2D": 2, "PntList3D": 3}


@dataclass(frozen=True)
class XmlElement:
    """One element of an alignment's geometry."""

    kind: str
    """Line, Curve, Spiral, or another name that the caller refuses."""
    start: tuple[float, float]
    """Easting, northing, unit of the file."""
    end: tuple[float, float]
    center: tuple[float, float] | None
    clockwise: bool
    radii: tuple[float, float] | None = None
    """Of a spiral at its start and end; inf where it is straight."""
    length: float | None = None
    """Of a spiral, as stated."""
    spiral: str = ""
    """The kind of spiral, as written: clothoid, or one that the caller refuses."""


@dataclass(frozen=True)
class XmlAlignment:
    """One alignment's plan geometry."""

    name: str
    start_station: float
    stated_length: float | None
    elements: tuple[XmlElement, ...]
    equations: int
    """Station equations, which make stations jump."""
    profiles: tuple[XmlProfile, ...] = ()


@dataclass
class _Heard:
    """An element of CoordGeom while it is read: points may still be names."""

    kind: str
    attributes: dict[str, str]
    vertices: dict[str, Place]
    chain: list[Place]


class AlignmentSection(Section):
    """Alignments: CoordGeom, Profile and StaEquation of each."""

    def __init__(self, source: str):
        super().__init__(source)
        self._profiles = ProfileSection(source)
        self._done: list[tuple[dict[str, str], list[_Heard], int, tuple[XmlProfile, ...]]] = []
        self._alignment: dict[str, str] = {}
        self._elements: list[_Heard] = []
        self._element: _Heard | None = None
        self._equations = 0
        self._vertex: dict[str, str] = {}

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name == "Alignment":
            self._alignment, self._elements, self._equations = attributes, [], 0
        elif name == "StaEquation":
            self._equations += 1
        elif path[-3:-1] == ["Alignment", "CoordGeom"] and name != "Feature":
            self.count("elements of alignments")
            self._element = _Heard(name, attributes, {}, [])
            return MAX_LIST_TEXT if name == "Chain" else 0
        elif self._element is not None:
            if name in _VERTICES:
                self._vertex = attributes
                return MAX_TEXT
            return MAX_LIST_TEXT if name in _LISTS else 0
        elif "Profile" in path:
            return self._profiles.start(name, attributes, path)
        return 0

    def end(self, name: str, text: str, path: list[str]) -> None:
        if name == "Alignment":
            if self._elements or self._alignment.get("name"):
                self._done.append((self._alignment, self._elements, self._equations, self._profiles.taken()))
            self._alignment, self._elements = {}, []
        elif path[-2:] == ["Alignment", "CoordGeom"] and self._element is not None:
            if name == "Chain":
                self._element.chain.extend(text.split())
            self._elements.append(self._element)
            self._element = None
        elif self._element is not None:
            self._end_vertex(name, text)
        elif "Profile" in path or name == "Profile":
            self._profiles.end(name, text, path)

    def alignments(self, points: PointSection) -> tuple[XmlAlignment, ...]:
        """All that were heard, with the points they refer to. Raises SurfaceError."""
        found = []
        for attributes, heard, equations, profiles in self._done:
            name = attributes.get("name", "")
            where = f"alignment '{name}'"
            elements = [element for one in heard for element in self._elements_of(one, points, where)]
            if not elements:
                continue
            start = self.number(attributes, "staStart", where)
            length = self.number(attributes, "length", where) if attributes.get("length") else None
            found.append(XmlAlignment(name, start or 0.0, length, tuple(elements), equations, profiles))
        return tuple(found)

    def _end_vertex(self, name: str, text: str) -> None:
        assert self._element is not None
        where = f"{name} of an alignment's element"
        if name in _VERTICES:
            place = place_of(self, text, self._vertex, where)
            if place is not None:
                self._element.vertices[name] = place
        elif size := _LISTS.get(name):
            numbers = self.numbers(text, size, where)
            if len(numbers) % size:
                raise SurfaceError(
                    f"{self.source}: {where} has {len(numbers)} numbers, which are no points of {size}; export it again"
                )
            for n, e in zip(numbers[::size], numbers[1::size], strict=True):
                self.count("elements of alignments")
                self._element.chain.append((e, n))

    def _elements_of(self, heard: _Heard, points: PointSection, where: str) -> list[XmlElement]:
        start, end = heard.vertices.get("Start"), heard.vertices.get("End")
        if heard.kind in ("Chain", "IrregularLine"):
            corners = [start, *heard.chain, end]
            places = [points.resolve(place, where) for place in corners if place is not None]
            if len(places) < 2:
                raise SurfaceError(f"{self.source}: a {heard.kind} of {where} has fewer than two points")
            # The list of an irregular line often begins with its Start and ends with its End.
            return [XmlElement("Line", a, b, None, False) for a, b in itertools.pairwise(places) if a != b]
        if start is None or end is None:
            raise SurfaceError(
                f"{self.source}: a {heard.kind} of {where} has no Start or no End; export it with coordinates, or with "
                "references to points of the same file"
            )
        center = heard.vertices.get("Center")
        spiral = heard.kind == "Spiral"
        return [
            XmlElement(
                heard.kind,
                points.resolve(start, where),
                points.resolve(end, where),
                None if center is None else points.resolve(center, where),
                heard.attributes.get("rot", "").lower() == "cw",
                self._radii(heard.attributes, where) if spiral else None,
                self.number(heard.attributes, "length", f"a spiral of {where}") if spiral else None,
                heard.attributes.get("spiType", "") if spiral else "",
            )
        ]

    def _radii(self, attributes: dict[str, str], where: str) -> tuple[float, float]:
        radii = []
        for key in ("radiusStart", "radiusEnd"):
            text = attributes.get(key, "").strip()
            radius = (
                math.inf if text.upper() in ("INF", "+INF") else self.numbers(text, 1, f"{key} of {where}")[0]
            )
            if radius <= 0:
                raise SurfaceError(
                    f"{self.source}: {key} of {where}: expected a positive number or INF, found '{text[:60]}'"
                )
            radii.append(radius)
        return radii[0], radii[1]
