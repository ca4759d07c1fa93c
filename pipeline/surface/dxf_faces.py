"""The faces of a DXF layer as one triangulated surface.

Corners that have the same coordinates are one point, so that faces which were drawn apart hang together. A face with a
corner given twice is a triangle; one with four is cut along the diagonal from its first corner.
"""

from __future__ import annotations

from array import array

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.dxf_entities import Entity, number_of
from pipeline.surface.landxml_surfaces import MAX_FACES, TinSurface

FACES = frozenset({"3DFACE", "POLYLINE", "MESH"})
_SAME_DIGITS = 6
"""Corners that agree to so many decimals are one point: drawings are written with six to sixteen."""
_MESH, _POLYFACE, _SMOOTH = 16, 64, 4
_FACE_CODES = (10, 20, 30, 11, 21, 31, 12, 22, 32, 13, 23, 33)

_Corners = list[tuple[float, float, float]]


class Faces:
    """The faces of a layer as they are heard; numbers are kept, entities are not."""

    def __init__(self, layer: str, source: str):
        """Both names are for messages."""
        self._layer, self._source = layer, source
        self._simple = array("d")
        self._blocks: list[np.ndarray] = []
        self._count = self._invisible = 0

    def add(self, entity: Entity) -> None:
        """One 3DFACE, MESH or POLYLINE; polylines that are no meshes are passed over. Raises SurfaceError."""
        source = self._source
        if entity.whole(60, source):
            self._invisible += 1
            return
        if entity.kind == "3DFACE":
            self._simple.extend(_face_corners(entity, source))
            self._count += 1
        else:
            corners = _mesh(entity, source) if entity.kind == "MESH" else _polyline_faces(entity, source)
            self._blocks.append(corners)
            self._count += len(corners)
        if self._count > MAX_FACES:
            raise SurfaceError(
                f"{source}: more than {MAX_FACES} faces on layer '{self._layer}'; cut it down to the job"
            )

    def surface(self, told: str) -> TinSurface:
        """All of them. Raises SurfaceError where there are none; `told` is what the layer holds."""
        where = f"{self._source}: layer '{self._layer}'"
        if not self._count:
            raise SurfaceError(
                f"{where} has no faces (3DFACE, polyface or mesh); {told}; export the surface as 3D faces, or mend "
                "design.layer in site.toml"
            )
        corners = np.concatenate([np.array(self._simple).reshape(-1, 4, 3), *self._blocks])
        points, index = _same_points(corners.reshape(-1, 3))
        quads = index.reshape(-1, 4)
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        if not len(faces):
            raise SurfaceError(f"{where}: all its faces are without extent; export the surface again")
        return TinSurface(self._layer, points, faces, self._invisible)


def _same_points(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct points (n, 3), and which of them each corner is."""
    rounded = np.round(corners, _SAME_DIGITS)
    order = np.lexsort(rounded.T)
    ranked = rounded[order]
    new = np.concatenate([[True], np.any(ranked[1:] != ranked[:-1], axis=1)])
    index = np.empty(len(corners), np.int64)
    index[order] = np.cumsum(new) - 1
    return ranked[new], index


def _face_corners(entity: Entity, source: str) -> list[float]:
    values = dict(entity.tags)
    if 13 not in values:  # a triangle may leave its fourth corner out
        for code in (13, 23, 33):
            values[code] = values.get(code - 1, b"")
    try:
        return [number_of(values[code], "3DFACE", source) for code in _FACE_CODES]
    except KeyError:
        raise SurfaceError(f"{source}: a 3DFACE without its corners; save the drawing again") from None


def _polyline_faces(entity: Entity, source: str) -> np.ndarray:
    """(n, 4, 3) corners of a polyface or of a mesh of rows and columns; none for a plain polyline."""
    flags = entity.whole(70, source)
    if flags & _POLYFACE:
        return _polyface(entity, source)
    if not flags & _MESH:
        return np.empty((0, 4, 3))
    if flags & _SMOOTH:
        raise SurfaceError(f"{source}: a mesh is smoothed; export it as 3D faces")
    rows, columns = entity.whole(71, source), entity.whole(72, source)
    points = np.array([vertex.point(10, source) for vertex in entity.vertices]).reshape(-1, 3)
    if rows < 2 or columns < 2 or rows * columns != len(points):
        raise SurfaceError(
            f"{source}: a mesh of {rows} by {columns} points has {len(points)} of them; save the drawing again"
        )
    net = points.reshape(rows, columns, 3)
    if flags & 1:
        net = np.concatenate([net, net[:1]])
    if flags & 32:
        net = np.concatenate([net, net[:, :1]], axis=1)
    corners = np.stack([net[:-1, :-1], net[:-1, 1:], net[1:, 1:], net[1:, :-1]], axis=2)
    return corners.reshape(-1, 4, 3)


def _polyface(entity: Entity, source: str) -> np.ndarray:
    points, faces = [], []
    for vertex in entity.vertices:
        if vertex.whole(70, source) & 64:
            points.append(vertex.point(10, source))
        else:
            # A negative number is a corner whose edge is not drawn.
            corners = [abs(vertex.whole(code, source)) for code in (71, 72, 73, 74)]
            faces.append([corner for corner in corners if corner])
    return _corners_of(points, [[corner - 1 for corner in face] for face in faces], "polyface", source)


def _mesh(entity: Entity, source: str) -> np.ndarray:
    """Corners of a MESH: a list of points, then one of faces, each after the number of its corners."""
    if entity.whole(91, source):
        raise SurfaceError(f"{source}: a MESH is smoothed; export it as 3D faces")
    points: _Corners = []
    numbers: list[int] = []
    part = 0
    point: list[float] = []
    for code, value in entity.tags:
        if code in (92, 93, 94, 95):
            part = code
        elif part == 92 and code in (10, 20, 30):
            point.append(number_of(value, "MESH", source))
            if len(point) == 3:
                points.append((point[0], point[1], point[2]))
                point = []
        elif part == 93 and code == 90:
            numbers.append(int(number_of(value, "MESH", source)))
    faces, at = [], 0
    while at < len(numbers):
        size = max(numbers[at], 0)
        faces.append(numbers[at + 1 : at + 1 + size])
        at += 1 + size
    return _corners_of(points, faces, "MESH", source)


def _corners_of(points: _Corners, faces: list[list[int]], kind: str, source: str) -> np.ndarray:
    """(n, 4, 3) corners of faces given by indices; a triangle has its last corner twice."""
    quads = []
    for face in faces:
        if not 3 <= len(face) <= 4:
            raise SurfaceError(
                f"{source}: a face of a {kind} has {len(face)} corners; export the surface as triangles"
            )
        if min(face) < 0 or max(face) >= len(points):
            raise SurfaceError(
                f"{source}: a face of a {kind} names a point that is not there; save the drawing again"
            )
        quads.append([*face, face[2]][:4])
    if not quads:
        return np.empty((0, 4, 3))
    return np.array(points)[np.array(quads)]
