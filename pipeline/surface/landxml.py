"""LandXML as it comes: surfaces, alignments, profiles and pipes in the unit of the file, read in one pass, in bounds.

Versions 1.0 to 2.0 and Inframodel differ by namespace only, so elements are told by their local name. Points are
northing, easting, elevation in the file and easting, northing, elevation from here on. A file from outside is
hostile until shown otherwise: no DTD, no entities, bounded depth, size, counts and text (defusedxml, streaming).
Each part of a file is heard by a `Section` of its own: ``landxml_surfaces`` ``landxml_alignments``
``landxml_profiles`` ``landxml_pipes``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from pipeline.config.site import METRES_PER_UNIT
from pipeline.errors import SurfaceError
from pipeline.surface.landxml_alignments import AlignmentSection, XmlAlignment, XmlElement
from pipeline.surface.landxml_pipes import METRES_PER_DIAMETER_UNIT, PipeSection, XmlPipe
from pipeline.surface.landxml_profiles import XmlProfile, XmlVertex
from pipeline.surface.landxml_section import PointSection, Section
from pipeline.surface.landxml_surfaces import SurfaceSection, TinSurface

__all__ = [
    "LandXml",
    "TinSurface",
    "XmlAlignment",
    "XmlElement",
    "XmlPipe",
    "XmlProfile",
    "XmlVertex",
    "profile_named",
    "read_landxml",
]

MAX_BYTES = 500_000_000
MAX_DEPTH = 64
_READ = 1 << 18

# LandXML's own words for units; "foot" is the international foot there.
_UNITS = {
    "meter": "m",
    "metre": "m",
    "foot": "international_foot",
    "ussurveyfoot": "us_survey_foot",
}


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_Item = TypeVar("_Item", bound=_Named)


@dataclass(frozen=True)
class LandXml:
    """What a file holds of use to us."""

    source: str
    unit: str | None
    """m, international_foot, us_survey_foot; None where the file does not say."""
    unit_as_written: str
    surfaces: tuple[TinSurface, ...]
    alignments: tuple[XmlAlignment, ...]
    placed_pipes: tuple[XmlPipe, ...] = ()
    pipe_fault: str = ""
    """Why the pipes cannot be used, one sentence; whoever wants only a surface need not care."""

    @property
    def pipes(self) -> tuple[XmlPipe, ...]:
        """The pipes of all networks. Raises SurfaceError where one cannot be placed."""
        if self.pipe_fault:
            raise SurfaceError(self.pipe_fault)
        return self.placed_pipes

    def surface(self, name: str | None, key: str = "design.surface") -> TinSurface:
        """The surface of that name, or the only one; `key` of site.toml asks for it. Raises SurfaceError."""
        return _pick(self.surfaces, name, self.source, "surface", key)

    def alignment(self, name: str | None) -> XmlAlignment:
        """The alignment of that name, or the only one. Raises SurfaceError."""
        return _pick(self.alignments, name, self.source, "alignment", "design.alignment")


def profile_named(alignment: XmlAlignment, name: str, source: str) -> XmlProfile:
    """The profile of that name along an alignment. Raises SurfaceError."""
    where = f"{source}: alignment '{alignment.name}'"
    return _pick(alignment.profiles, name, where, "profile", "design.profile")


def read_landxml(path: Path) -> LandXml:
    """Surfaces, alignments with their profiles, and pipes of a LandXML file.

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


def _pick(found: tuple[_Item, ...], name: str | None, source: str, noun: str, key: str) -> _Item:
    if not found:
        table = key.partition(".")[0]
        raise SurfaceError(f"{source}: holds no {noun}; export one, or mend {table}.file in site.toml")
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
    """Target of the parser: holds depth and text in bounds, and hands each part of the file to its section."""

    def __init__(self, source: str):
        self.source = source
        self._surfaces = SurfaceSection(source)
        self._alignments = AlignmentSection(source)
        self._pipes = PipeSection(source)
        self._points = PointSection(source)
        self._units = _UnitSection(source)
        self._sections: dict[str, Section] = {
            "Units": self._units,
            "CgPoints": self._points,
            "Surfaces": self._surfaces,
            "Surface": self._surfaces,
            "Alignments": self._alignments,
            "Alignment": self._alignments,
            "PipeNetworks": self._pipes,
        }
        self._section: Section | None = None
        self._section_depth = 0
        self._path: list[str] = []
        self._text: list[str] = []
        self._text_depth = 0  # of the element whose text is wanted; 0 where none is
        self._limit = self._left = 0  # characters that it may have, and may still have
        self._local: dict[str, str] = {}

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
        section = self._section
        if section is None:
            section = self._section = self._sections.get(name)
            self._section_depth = len(path)
            if section is None:
                return
        if limit := section.start(name, attributes, path):
            self._limit = self._left = limit
            self._text, self._text_depth = [], len(path)

    def data(self, text: str) -> None:
        # Elements inside, such as the features of a point, have texts of their own.
        if self._text_depth == len(self._path):
            self._text.append(text)
            self._left -= len(text)
            if self._left < 0:
                raise SurfaceError(
                    f"{self.source}: a {self._path[-1]} element with more than {self._limit} characters"
                )

    def end(self, tag: str) -> None:
        name = self._path.pop()
        if self._section is None:
            return
        text = ""
        if self._text_depth == len(self._path) + 1:
            text, self._text_depth = "".join(self._text), 0
        self._section.end(name, text, self._path)
        if len(self._path) < self._section_depth:
            self._section = None

    def close(self) -> None:
        pass

    def result(self) -> LandXml:
        written = self._units.linear
        unit = _UNITS.get(written.lower()) if written else None
        diameter = METRES_PER_DIAMETER_UNIT.get(self._units.diameter.lower())
        scale = diameter / METRES_PER_UNIT[unit] if diameter and unit else None
        pipes: tuple[XmlPipe, ...] = ()
        fault = ""
        try:
            pipes = self._pipes.pipes(self._points, scale)
        except SurfaceError as error:
            fault = str(error)
        return LandXml(
            self.source,
            unit,
            written,
            tuple(self._surfaces.surfaces),
            self._alignments.alignments(self._points),
            pipes,
            fault,
        )


class _UnitSection(Section):
    """Units: what lengths and diameters are in."""

    def __init__(self, source: str):
        super().__init__(source)
        self.linear = ""
        self.diameter = ""

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name in ("Metric", "Imperial"):
            self.linear = attributes.get("linearUnit", "")
            self.diameter = attributes.get("diameterUnit", "")
            heights = attributes.get("elevationUnit")
            feet = name == "Imperial" and heights == "feet"  # LandXML's only word for either foot
            if heights and heights != self.linear and not feet:
                raise SurfaceError(
                    f"{self.source}: linearUnit is '{self.linear}' but elevationUnit is '{heights}'; "
                    "export it with one unit"
                )
        return 0

    def end(self, name: str, text: str, path: list[str]) -> None:
        pass
