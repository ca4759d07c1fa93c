"""Profiles of a LandXML alignment: points of vertical intersection with their curves, and levels along a surface."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import SurfaceError
from pipeline.surface.landxml_section import MAX_LIST_TEXT, MAX_TEXT, Section

CURVES = {
    "PVI": (),
    "ParaCurve": ("length",),
    "UnsymParaCurve": ("lengthIn", "lengthOut"),
    "CircCurve": ("radius", "length"),
}
"""What stands at a point of vertical intersection, and the attributes that shape it."""


@dataclass(frozen=True)
class XmlVertex:
    """A point of vertical intersection, where two gradients meet, and how it is rounded."""

    kind: str
    """PVI (not at all), ParaCurve, UnsymParaCurve, CircCurve."""
    station: float
    """Unit of the file, as are all lengths here."""
    elevation: float
    length_in: float | None = None
    """Horizontal length of a parabola before and after the point."""
    length_out: float | None = None
    radius: float | None = None
    """Of a circular curve; the sign is left to the gradients."""
    length: float | None = None
    """Of a circular curve, as stated."""


@dataclass(frozen=True)
class XmlProfile:
    """Levels along an alignment."""

    name: str
    kind: str
    """ProfAlign (designed gradients and curves) or ProfSurf (levels along a surface)."""
    vertices: tuple[XmlVertex, ...]
    gaps: int = 0
    """Breaks between the lists of a ProfSurf."""


class ProfileSection(Section):
    """The Profile elements of one alignment after the other."""

    def __init__(self, source: str):
        super().__init__(source)
        self._profiles: list[XmlProfile] = []
        self._name = ""
        self._attributes: dict[str, str] = {}
        self._new_profile("")

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name == "Profile":
            self._name = attributes.get("name", "")
        elif name in ("ProfAlign", "ProfSurf"):
            self._new_profile(attributes.get("name") or self._name)
        elif path[-2] == "ProfAlign" and name in CURVES:
            self._attributes = attributes
            return MAX_TEXT
        elif path[-2] == "ProfSurf" and name == "PntList2D":
            return MAX_LIST_TEXT
        return 0

    def end(self, name: str, text: str, path: list[str]) -> None:
        if name in ("ProfAlign", "ProfSurf"):
            if self._vertices:
                gaps = max(self._lists - 1, 0)
                self._profiles.append(XmlProfile(self._own, name, tuple(self._vertices), gaps))
            self._new_profile("")
        elif path[-1] == "ProfAlign" and name in CURVES:
            self._end_vertex(name, text)
        elif path[-1] == "ProfSurf" and name == "PntList2D":
            numbers = self.numbers(text, 4, f"the list of profile '{self._own}'")
            if len(numbers) % 2:
                raise SurfaceError(
                    f"{self.source}: the list of profile '{self._own}' has {len(numbers)} numbers, which are no pairs "
                    "of station and elevation"
                )
            self._lists += 1
            for station, elevation in zip(numbers[::2], numbers[1::2], strict=True):
                self.count("vertices of profiles")
                self._vertices.append(XmlVertex("PVI", station, elevation))

    def taken(self) -> tuple[XmlProfile, ...]:
        """The profiles since the last time this was asked."""
        found, self._profiles = self._profiles, []
        return tuple(found)

    def _new_profile(self, name: str) -> None:
        self._own = name
        self._vertices: list[XmlVertex] = []
        self._lists = 0

    def _end_vertex(self, kind: str, text: str) -> None:
        where = f"a {kind} of profile '{self._own}'"
        station, elevation = self.numbers(text, 2, where)[:2]
        shape = {key: self.number(self._attributes, key, where) for key in CURVES[kind]}
        needed = "radius" if kind == "CircCurve" else None
        missing = [key for key, value in shape.items() if value is None and (needed is None or key == needed)]
        if missing:
            raise SurfaceError(
                f"{self.source}: {where} at station {station:g} has no {missing[0]}; export it again"
            )
        if kind == "ParaCurve":
            assert shape["length"] is not None
            shape["lengthIn"] = shape["lengthOut"] = 0.5 * shape["length"]
        self.count("vertices of profiles")
        circular = kind == "CircCurve"
        self._vertices.append(
            XmlVertex(
                kind,
                station,
                elevation,
                shape.get("lengthIn"),
                shape.get("lengthOut"),
                shape.get("radius"),
                shape.get("length") if circular else None,
            )
        )
