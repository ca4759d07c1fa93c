"""Triangulated surfaces of a LandXML file."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.landxml_section import MAX_TEXT, Section

MAX_POINTS = 5_000_000
MAX_FACES = 10_000_000


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


class SurfaceSection(Section):
    """Surfaces: points and faces of each one's Definition."""

    def __init__(self, source: str):
        super().__init__(source)
        self.surfaces: list[TinSurface] = []
        self._attributes: dict[str, str] = {}
        self._new_surface("")

    def start(self, name: str, attributes: dict[str, str], path: list[str]) -> int:
        if name in ("P", "F"):
            if path[-3] == "Definition":
                self._attributes = attributes
                return MAX_TEXT
        elif name == "Surface":
            self._new_surface(attributes.get("name", ""))
        elif name == "Definition":
            for key in ("area2DSurf", "area3DSurf", "elevMin", "elevMax"):
                stated = self.number(attributes, key, f"surface '{self._name}'")
                if stated is not None:
                    self._stated[key] = stated
        return 0

    def end(self, name: str, text: str, path: list[str]) -> None:
        if name == "F":
            if path[-2] == "Definition":
                self._end_face(text)
        elif name == "P":
            if path[-2] == "Definition":
                self._end_point(text)
        elif name == "Surface":
            self._end_surface()

    def _new_surface(self, name: str) -> None:
        self._name = name
        self._stated: dict[str, float] = {}
        self._coordinates = array("d")
        self._index_of: dict[str, int] = {}
        self._corners: list[str] = []
        self._invisible = 0

    def _end_point(self, text: str) -> None:
        identity = self._attributes.get("id", "")
        n, e, h = self.numbers(text, 3, f"point {identity} of surface '{self._name}'")[:3]
        if identity in self._index_of:
            raise SurfaceError(f"{self.source}: surface '{self._name}' has two points with id {identity}")
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
                f"{self.source}: a face of surface '{self._name}' has {len(corners)} corners, expected 3"
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
                    f"{self.source}: a face of surface '{self._name}' names point {error}, which it has not"
                ) from None
            points = np.array(self._coordinates).reshape(-1, 3)
            self.surfaces.append(TinSurface(self._name, points, faces, self._invisible, self._stated))
        self._new_surface("")
