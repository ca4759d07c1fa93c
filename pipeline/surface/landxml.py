"""LandXML as it comes: surfaces and alignments in the unit of the file, read in one pass and within bounds.

Versions 1.0 to 2.0 and Inframodel differ by namespace only, so elements are told by their local name. Points are
northing, easting, elevation in the file and easting, northing, elevation from here on. A file from outside is
hostile until shown otherwise: no DTD, no entities, bounded depth, size, counts and text (defusedxml, streaming).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from pipeline.errors import SurfaceError

MAX_BYTES = 500_000_000
MAX_DEPTH = 64
MAX_POINTS = 5_000_000
MAX_FACES = 10_000_000
MAX_TEXT = 10_000
"""Characters of one element that we read; a point has under a hundred."""
_READ = 1 << 18

# LandXML's own words for units; "foot" is the international foot there.
_UNITS = {
    "meter": "m",
    "metre": "m",
    "foot": "international_foot",
    "ussurveyfoot": "us_survey_foot",
}


@dataclass(frozen=True)
class TinSurface:
    """One triangulated surface."""

    name: str
    points: np.ndarray
    """(n, 3) easting, northing, elevation, unit of the file."""
    faces: np.ndarray
    """(m, 3) int, visible faces only."""
    invisible: int
    """Faces that were skipped because the file says so (``i="1"``)."""
    stated: dict[str, float] = field(default_factory=dict)
    """What the file itself says: area2DSurf, area3DSurf, elevMin, elevMax, where given."""


@dataclass(frozen=True)
class XmlElement:
    """One element of an alignment's geometry."""

    kind: str
    """Line, Curve, or another name that the caller refuses."""
    start: tuple[float, float]
    """Easting, northing, unit of the file."""
    end: tuple[float, float]
    center: tuple[float, float] | None
    clockwise: bool


@dataclass(frozen=True)
class XmlAlignment:
    """One alignment's plan geometry."""

    name: str
    start_station: float
    stated_length: float | None
    elements: tuple[XmlElement, ...]
    equations: int
    """Station equations, which make stations jump."""


@dataclass(frozen=True)
class LandXml:
    """What a file holds of use to us."""

    source: str
    unit: str | None
    """m, international_foot, us_survey_foot; None where the file does not say."""
    unit_as_written: str
    surfaces: tuple[TinSurface, ...]
    alignments: tuple[XmlAlignment, ...]

    def surface(self, name: str | None) -> TinSurface:
        """The surface of that name, or the only one. Raises SurfaceError."""
        return _pick(self.surfaces, name, self.source, "surface", "design.surface")

    def alignment(self, name: str | None) -> XmlAlignment:
        """The alignment of that name, or the only one. Raises SurfaceError."""
        return _pick(self.alignments, name, self.source, "alignment", "design.alignment")


def read_landxml(path: Path) -> LandXml:
    """Surfaces and alignments of a LandXML file.

    Raises
    ------
    SurfaceError
        No such file, no LandXML, forbidden constructs, out of bounds, or a point or face that makes no sense.
    """
    source = path.name
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SurfaceError(
                f"{source}: {size / 1e6:.0f} MB, at most {MAX_BYTES / 1e6:.0f} MB are read; "
                "cut the design down to the job"
            )
        if size == 0:
            raise SurfaceError(f"{source}: is empty; export the design again")
        reader = _Reader(source)
        parser = DefusedXMLParser(target=reader, forbid_dtd=True, forbid_entities=True, forbid_external=True)
        with path.open("rb") as stream:
            while piece := stream.read(_READ):
                parser.feed(piece)
        parser.close()
    except DefusedXmlException:
        raise SurfaceError(
            f"{source}: holds a document type or entities, which LandXML does not need and a hostile file may; "
            "export the design again without them"
        ) from None
    except ParseError as error:
        raise SurfaceError(f"{source}: not well-formed XML ({error}); export the design again") from None
    except (LookupError, UnicodeError, ValueError) as error:
        raise SurfaceError(f"{source}: cannot be read as XML ({error}); export the design again") from None
    except OSError as error:
        raise SurfaceError(f"{source}: cannot be read ({error.strerror}); is it beside site.toml?") from None
    return reader.result()


def _pick(found, name, source, noun, key):
    if not found:
        raise SurfaceError(f"{source}: holds no {noun}; export one, or mend design.file in site.toml")
    names = [item.name for item in found]
    if name is None:
        if len(found) > 1:
            raise SurfaceError(
                f"{source}: holds {len(found)} {noun}s ({_listed(names)}); say which with {key} in site.toml"
            )
        return found[0]
    chosen = [item for item in found if item.name == name]
    if not chosen:
        raise SurfaceError(
            f"{source}: has no {noun} '{name}'; it holds {_listed(names)}; mend {key} in site.toml"
        )
    if len(chosen) > 1:
        raise SurfaceError(f"{source}: has {len(chosen)} {noun}s called '{name}'; give them different names")
    return chosen[0]


def _listed(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names[:8]) + (", ..." if len(names) > 8 else "")


class _Reader:
    """Target of the parser: hears elements, keeps numbers."""

    def __init__(self, source: str):
        self.source = source
        self.unit_as_written = ""
        self.surfaces: list[TinSurface] = []
        self.alignments: list[XmlAlignment] = []
        self._path: list[str] = []
        self._skipped = 0  # depth below an element that does not concern us
        self._text: list[str] | None = None
        self._text_length = 0
        self._attributes: dict[str, str] = {}
        self._local: dict[str, str] = {}
        self._new_surface("")
        self._new_alignment({})
        self._element: tuple[str, dict[str, str]] | None = None
        self._vertices: dict[str, tuple[float, float]] = {}
        self._starts: dict[str, Callable[[dict[str, str]], None]] = {
            "Units": self._start_nothing,
            "Metric": self._start_unit,
            "Imperial": self._start_unit,
            "Surface": self._start_surface,
            "Definition": self._start_definition,
            "Alignment": self._new_alignment,
            "StaEquation": self._start_equation,
        }

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        name = self._local.get(tag)
        if name is None:
            name = self._local[tag] = tag.rpartition("}")[2]
        path = self._path
        if not path and name != "LandXML":
            raise SurfaceError(f"{self.source}: is XML, but its first element is '{name}' and not LandXML")
        path.append(name)
        if len(path) > MAX_DEPTH:
            raise SurfaceError(
                f"{self.source}: elements nested deeper than {MAX_DEPTH}; this is no sound LandXML"
            )
        if name in ("P", "F"):
            if len(path) >= 3 and path[-3] == "Definition":
                self._attributes = attributes
                self._text, self._text_length = [], 0
        elif path[-2:-1] == ["CoordGeom"]:
            if path[-3:-2] == ["Alignment"]:
                self._element, self._vertices = (name, attributes), {}
        elif name in ("Start", "End", "Center"):
            if self._element is not None:
                self._text, self._text_length = [], 0
        elif handle := self._starts.get(name):
            handle(attributes)

    def data(self, text: str) -> None:
        if self._text is not None:
            self._text.append(text)
            self._text_length += len(text)
            if self._text_length > MAX_TEXT:
                raise SurfaceError(
                    f"{self.source}: a {self._path[-1]} element with more than {MAX_TEXT} characters"
                )

    def end(self, tag: str) -> None:
        name = self._path.pop()
        if self._text is not None:
            text = "".join(self._text)
            self._text = None
            if name == "P":
                self._end_point(text)
            elif name == "F":
                self._end_face(text)
            else:
                numbers = self._numbers(text, 2, f"{name} of an alignment's element")
                self._vertices[name] = (numbers[1], numbers[0])
        elif name == "Surface":
            self._end_surface()
        elif name == "Alignment":
            self._end_alignment()
        elif self._path[-1:] == ["CoordGeom"] and self._element is not None:
            self._end_element()

    def close(self) -> None:
        pass

    def result(self) -> LandXml:
        unit = _UNITS.get(self.unit_as_written.lower()) if self.unit_as_written else None
        return LandXml(self.source, unit, self.unit_as_written, tuple(self.surfaces), tuple(self.alignments))

    def _start_nothing(self, attributes: dict[str, str]) -> None:
        pass

    def _start_unit(self, attributes: dict[str, str]) -> None:
        if self._path[-2] == "Units":
            self.unit_as_written = attributes.get("linearUnit", "")
            heights = attributes.get("elevationUnit")
            feet = self._path[-1] == "Imperial" and heights == "feet"  # LandXML's only word for either foot
            if heights and heights != self.unit_as_written and not feet:
                raise SurfaceError(
                    f"{self.source}: linearUnit is '{self.unit_as_written}' but elevationUnit is '{heights}'; "
                    "export it with one unit"
                )

    def _new_surface(self, name: str) -> None:
        self._surface_name = name
        self._surface_kind = ""
        self._stated: dict[str, float] = {}
        self._coordinates = array("d")
        self._index_of: dict[str, int] = {}
        self._corners: list[str] = []
        self._invisible = 0

    def _start_surface(self, attributes: dict[str, str]) -> None:
        self._new_surface(attributes.get("name", ""))

    def _start_definition(self, attributes: dict[str, str]) -> None:
        self._surface_kind = attributes.get("surfType", "")
        for key in ("area2DSurf", "area3DSurf", "elevMin", "elevMax"):
            if key in attributes:
                self._stated[key] = self._numbers(
                    attributes[key], 1, f"{key} of surface '{self._surface_name}'"
                )[0]

    def _end_point(self, text: str) -> None:
        identity = self._attributes.get("id", "")
        n, e, h = self._numbers(text, 3, f"point {identity} of surface '{self._surface_name}'")[:3]
        if identity in self._index_of:
            raise SurfaceError(
                f"{self.source}: surface '{self._surface_name}' has two points with id {identity}"
            )
        if len(self._index_of) >= MAX_POINTS:
            raise SurfaceError(
                f"{self.source}: a surface of more than {MAX_POINTS} points; cut it down to the job"
            )
        self._index_of[identity] = len(self._index_of)
        self._coordinates.extend((e, n, h))

    def _end_face(self, text: str) -> None:
        if self._attributes.get("i") == "1":
            self._invisible += 1
            return
        corners = text.split()
        if len(corners) == 3:
            self._corners += corners
        elif len(corners) == 4:  # faces of a grid surface
            self._corners += [*corners[:3], corners[0], *corners[2:]]
        else:
            raise SurfaceError(
                f"{self.source}: a face of surface '{self._surface_name}' has {len(corners)} corners, expected 3"
            )
        if len(self._corners) > 3 * MAX_FACES:
            raise SurfaceError(
                f"{self.source}: a surface of more than {MAX_FACES} faces; cut it down to the job"
            )

    def _end_surface(self) -> None:
        if self._index_of and self._corners:
            try:
                faces = np.array([self._index_of[corner] for corner in self._corners]).reshape(-1, 3)
            except KeyError as error:
                raise SurfaceError(
                    f"{self.source}: a face of surface '{self._surface_name}' names point {error}, which it has not"
                ) from None
            points = np.array(self._coordinates).reshape(-1, 3)
            self.surfaces.append(TinSurface(self._surface_name, points, faces, self._invisible, self._stated))
        self._new_surface("")

    def _new_alignment(self, attributes: dict[str, str]) -> None:
        self._alignment = attributes
        self._elements: list[XmlElement] = []
        self._equations = 0

    def _start_equation(self, attributes: dict[str, str]) -> None:
        self._equations += 1

    def _end_element(self) -> None:
        assert self._element is not None
        kind, attributes = self._element
        vertices, self._element = self._vertices, None
        if "Start" not in vertices or "End" not in vertices:
            raise SurfaceError(
                f"{self.source}: a {kind} of alignment '{self._alignment.get('name', '')}' has no Start or no End "
                "written as coordinates; export it with coordinates instead of point references"
            )
        self._elements.append(
            XmlElement(
                kind,
                vertices["Start"],
                vertices["End"],
                vertices.get("Center"),
                attributes.get("rot", "").lower() == "cw",
            )
        )

    def _end_alignment(self) -> None:
        name = self._alignment.get("name", "")
        if self._elements:
            where = f"alignment '{name}'"
            length = self._alignment.get("length")
            self.alignments.append(
                XmlAlignment(
                    name,
                    self._numbers(self._alignment.get("staStart", "0"), 1, f"staStart of {where}")[0],
                    self._numbers(length, 1, f"length of {where}")[0] if length else None,
                    tuple(self._elements),
                    self._equations,
                )
            )
        self._new_alignment({})

    def _numbers(self, text: str, least: int, where: str) -> list[float]:
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) < least or not all(map(math.isfinite, numbers)):
            raise SurfaceError(
                f"{self.source}: {where}: expected {least} numbers, found '{text.strip()[:60]}'"
            )
        return numbers
