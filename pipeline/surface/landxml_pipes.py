"""Pipe networks of a LandXML file: pipes between structures, at the inverts that the structures state."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

from pipeline.errors import SurfaceError
from pipeline.surface.landxml_section import MAX_TEXT, Place, PointSection, Section, place_of

METRES_PER_DIAMETER_UNIT = {
    "millimeter": 0.001,
    "centimeter": 0.01,
    "meter": 1.0,
    "inch": 0.0254,
    "foot": 0.3048,
    "ussurveyfoot": 1200 / 3937,
}
_SHAPES = ("CircPipe", "RectPipe", "EggPipe", "ElliPipe", "Channel")
_CHORD_ERROR = 0.001
"""How far a curved pipe's chords may leave its arc, in the unit of the file."""
_MAX_CHORDS = 1000


@dataclass(frozen=True)
class XmlPipe:
    """One straight pipe, or one chord of a curved one."""

    network: str
    name: str
    start: tuple[float, float, float]
    """Easting, northing and invert elevation, unit of the file."""
    end: tuple[float, float, float]
    diameter: float | None
    """Inner, in the linear unit of the file; None where the file does not say, or not in which unit."""


@dataclass
class _Struct:
    center: Place | None = None
    inverts: dict[str, list[tuple[str, float]]] = field(default_factory=dict)
    """By pipe: direction of flow, elevation."""


@dataclass
class _Pipe:
    name: str
    ends: tuple[str, str]
    center: Place | None = None
    diameter: float | None = None


@dataclass
class _Network:
    name: str
    structs: dict[str, _Struct] = field(default_factory=dict)
    pipes: list[_Pipe] = field(default_factory=list)


class PipeSection(Section):
    """PipeNetworks: structures with their inverts, and the pipes between them."""

    def __init__(self, source: str):
        super().__init__(source)
        self._networks: list[_Network] = []
        self._struct = _Struct()
        self._pipe = _Pipe("", ("", ""))
        self._attributes: dict[str, str] = {}

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name == "PipeNetwork":
            self._networks.append(_Network(attributes.get("name", "")))
        elif not self._networks:
            return 0
        elif name == "Struct":
            self._start_struct(attributes)
        elif name == "Pipe":
            self.count("pipes and structures")
            ends = attributes.get("refStart", ""), attributes.get("refEnd", "")
            self._pipe = _Pipe(attributes.get("name", ""), ends)
            self._networks[-1].pipes.append(self._pipe)
        elif name == "Invert" and path[-2] == "Struct":
            self.count("pipes and structures")
            where = f"an Invert of network '{self._networks[-1].name}'"
            elevation = self.number(attributes, "elev", where)
            if elevation is not None:
                flow = attributes.get("flowDir", "").lower()
                self._struct.inverts.setdefault(attributes.get("refPipe", ""), []).append((flow, elevation))
        elif name in _SHAPES and path[-2] == "Pipe":
            self._pipe.diameter = self.number(attributes, "diameter", f"pipe '{self._pipe.name}'")
        elif name == "Center" and path[-2] in ("Struct", "Pipe"):
            self._attributes = attributes
            return MAX_TEXT
        return 0

    def end(self, name: str, text: str, path: list[str]) -> None:
        if name == "Center" and path[-1] in ("Struct", "Pipe"):
            place = place_of(self, text, self._attributes, f"Center of a {path[-1]}")
            (self._struct if path[-1] == "Struct" else self._pipe).center = place

    def pipes(self, points: PointSection, diameter_scale: float | None) -> tuple[XmlPipe, ...]:
        """All pipes in their place. Raises SurfaceError for one that cannot be placed: none is dropped in silence.

        Parameters
        ----------
        points : PointSection
            The points that centres may refer to.
        diameter_scale : float, optional
            Linear units of the file per unit of its diameters; None where the file does not say.
        """
        return tuple(
            piece
            for network in self._networks
            for pipe in network.pipes
            for piece in self._placed(network, pipe, points, diameter_scale)
        )

    def _start_struct(self, attributes: dict[str, str]) -> None:
        self.count("pipes and structures")
        network, name = self._networks[-1], attributes.get("name", "")
        if name in network.structs:
            raise SurfaceError(f"{self.source}: network '{network.name}' has two structures called '{name}'")
        self._struct = network.structs[name] = _Struct()

    def _placed(
        self, network: _Network, pipe: _Pipe, points: PointSection, diameter_scale: float | None
    ) -> list[XmlPipe]:
        where = f"pipe '{pipe.name}' of network '{network.name}'"
        ends = []
        for name, flow in zip(pipe.ends, ("out", "in"), strict=True):
            struct = network.structs.get(name)
            if struct is None or struct.center is None:
                raise SurfaceError(
                    f"{self.source}: {where} ends at structure '{name}', which is not there or has no Center; export "
                    "the network with its structures"
                )
            e, n = points.resolve(struct.center, f"structure '{name}'")
            ends.append((e, n, self._invert(struct, pipe.name, flow, f"{where} has at structure '{name}'")))
        start, end = ends
        scaled = pipe.diameter is not None and diameter_scale is not None
        diameter = pipe.diameter * diameter_scale if scaled else None  # type: ignore[operator]
        corners = [start, end]
        if pipe.center is not None:
            corners = _chords(start, end, points.resolve(pipe.center, where))
            for _ in corners[2:]:
                self.count("pipes and structures")
        return [XmlPipe(network.name, pipe.name, a, b, diameter) for a, b in itertools.pairwise(corners)]

    def _invert(self, struct: _Struct, pipe: str, flow: str, where: str) -> float:
        own = struct.inverts.get(pipe, [])
        levels = {level for direction, level in own if direction == flow} or {level for _, level in own}
        if len(levels) != 1:
            raise SurfaceError(
                f"{self.source}: {where} {len(levels) or 'no'} invert elevation{'s' if levels else ''}; export the "
                "network with one Invert for each end of each pipe"
            )
        return levels.pop()


def _chords(
    start: tuple[float, float, float], end: tuple[float, float, float], center: tuple[float, float]
) -> list[tuple[float, float, float]]:
    """Corners along the shorter arc about a centre, close enough together; the invert falls evenly along it."""
    a = complex(start[0] - center[0], start[1] - center[1])
    b = complex(end[0] - center[0], end[1] - center[1])
    if abs(a) <= _CHORD_ERROR or abs(b) <= _CHORD_ERROR:
        return [start, end]
    angle = math.remainder(math.atan2(b.imag, b.real) - math.atan2(a.imag, a.real), 2 * math.pi)
    each = 2 * math.acos(1 - _CHORD_ERROR / abs(a))
    count = min(max(1, math.ceil(abs(angle) / each)), _MAX_CHORDS)
    corners = [start]
    for k in range(1, count):
        share = k / count
        # The radius goes evenly from one end's to the other's, so that rounding in the file leaves no step.
        at = (abs(a) + share * (abs(b) - abs(a))) * a / abs(a)
        at *= complex(math.cos(share * angle), math.sin(share * angle))
        corners.append((center[0] + at.real, center[1] + at.imag, start[2] + share * (end[2] - start[2])))
    return [*corners, end]
