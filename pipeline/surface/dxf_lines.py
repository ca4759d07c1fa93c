"""The lines of a DXF layer as one alignment: polylines with their bulges, lines and arcs, joined end to end."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.errors import SurfaceError
from pipeline.surface.dxf_entities import Entity, number_of
from pipeline.surface.landxml_alignments import XmlAlignment, XmlElement

LINES = frozenset({"LINE", "ARC", "LWPOLYLINE", "POLYLINE", "SPLINE", "ELLIPSE", "CIRCLE"})
"""The last three are known so that they can be refused: an alignment with a hole in it would be worse."""
MAX_LINES = 100_000
_JOINT = 0.005
"""How far apart two pieces may end and still be joined, in the unit of the drawing."""
_CLOSED, _SPLINE_FIT, _MESHES = 1, 4, 16 | 64
_FRAME = 16

_Point = tuple[float, float]


@dataclass
class _Piece:
    """Elements end to end, as drawn."""

    elements: list[XmlElement]
    either_way: bool
    """An arc: it is always stored counter-clockwise, which says nothing of where it leads."""

    @property
    def start(self) -> _Point:
        return self.elements[0].start

    @property
    def end(self) -> _Point:
        return self.elements[-1].end

    def turned(self) -> list[XmlElement]:
        return [
            XmlElement(e.kind, e.end, e.start, e.center, not e.clockwise if e.center else False)
            for e in reversed(self.elements)
        ]


def line_of(entities: list[Entity], layer: str, source: str, told: str, start_station: float) -> XmlAlignment:
    """The one line that the entities of a layer make.

    Parameters
    ----------
    entities : list of Entity
        Of `LINES`, all of one layer.
    layer, source : str
        Its name, and the drawing's, for messages.
    told : str
        What the layer holds, for the message that it has no lines.
    start_station : float
        Station of its first point, unit of the drawing.

    Raises
    ------
    SurfaceError
        When there is no line, or they are not one line drawn in one direction.
    """
    where = f"{source}: layer '{layer}'"
    pieces = []
    for entity in entities:
        if entity.kind in ("SPLINE", "ELLIPSE", "CIRCLE"):
            raise SurfaceError(f"{where} has a {entity.kind}; convert it to a polyline with arcs")
        piece = _piece(entity, where, source)
        if piece is not None:
            pieces.append(piece)
    if not pieces:
        raise SurfaceError(
            f"{where} has no lines, arcs or polylines; {told}; mend design.alignment_layer in site.toml"
        )
    elements = pieces[0].elements if len(pieces) == 1 else _joined(pieces, where)
    return XmlAlignment(layer, start_station, None, tuple(elements), 0)


def _piece(entity: Entity, where: str, source: str) -> _Piece | None:
    if entity.kind == "LINE":
        a, b = entity.point(10, source)[:2], entity.point(11, source)[:2]
        return _Piece([XmlElement("Line", a, b, None, False)], False) if a != b else None
    if entity.kind == "ARC":
        return _Piece([_arc(entity, source)], True)
    corners: list[tuple[float, float, float]] = []
    flags = entity.whole(70, source)
    if entity.kind == "LWPOLYLINE":
        for code, value in entity.tags:
            if code == 10:
                corners.append((number_of(value, entity.kind, source), math.nan, 0.0))
            elif corners and code in (20, 42):
                x, y, bulge = corners[-1]
                number = number_of(value, entity.kind, source)
                corners[-1] = (x, number, bulge) if code == 20 else (x, y, number)
        if any(math.isnan(y) for _, y, _ in corners):
            raise SurfaceError(f"{where}: a LWPOLYLINE has a point without y; save the drawing again")
        flat = True
    else:
        if flags & _MESHES:
            return None
        if flags & _SPLINE_FIT:
            raise SurfaceError(
                f"{where} has a polyline that is smoothed to a spline; convert it to lines and arcs"
            )
        for vertex in entity.vertices:
            if not vertex.whole(70, source) & _FRAME:
                x, y, _ = vertex.point(10, source)
                corners.append((x, y, vertex.first(42, 0.0, source)))
        flat = not flags & 8
    if flags & _CLOSED:
        raise SurfaceError(f"{where} has a closed polyline; an alignment has a start and an end")
    # A 3D polyline is drawn in the world itself, the others in a plane that may be seen from below.
    mirrored = flat and entity.is_mirrored(source)
    sign = -1.0 if mirrored else 1.0
    elements = []
    for (x, y, bulge), (u, v, _) in itertools.pairwise(corners):
        a, b = (sign * x, y), (sign * u, v)
        if a != b:
            elements.append(_segment(a, b, sign * bulge))
    return _Piece(elements, False) if elements else None


def _segment(a: _Point, b: _Point, bulge: float) -> XmlElement:
    """A line, or the arc whose bulge is the tangent of a quarter of its angle, counter-clockwise positive."""
    if abs(bulge) < 1e-12:
        return XmlElement("Line", a, b, None, False)
    half = (1 - bulge * bulge) / (4 * bulge)
    middle = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])
    center = middle[0] - half * (b[1] - a[1]), middle[1] + half * (b[0] - a[0])
    return XmlElement("Curve", a, b, center, bulge < 0)


def _arc(entity: Entity, source: str) -> XmlElement:
    x, y, _ = entity.point(10, source)
    radius = entity.first(40, 0.0, source)
    if radius <= 0:
        raise SurfaceError(f"{source}: an ARC without a radius; save the drawing again")
    ends = []
    for code in (50, 51):
        angle = math.radians(entity.first(code, 0.0, source))
        ends.append((x + radius * math.cos(angle), y + radius * math.sin(angle)))
    mirrored = entity.is_mirrored(source)
    if mirrored:
        x, ends = -x, [(-u, v) for u, v in ends]
    return XmlElement("Curve", ends[0], ends[1], (x, y), mirrored)


def _joined(pieces: list[_Piece], where: str) -> list[XmlElement]:
    """Elements of all pieces from one free end to the other."""
    advice = "join the pieces to one polyline, alone on its layer"
    ends = np.array([point for piece in pieces for point in (piece.start, piece.end)])
    # Asking for the nearest three, the end itself among them, finds its partner and whether there is another.
    _, near = cKDTree(ends).query(ends, k=3, distance_upper_bound=_JOINT)
    partner = np.full(len(ends), -1)
    for own, found in enumerate(near):
        others = [int(k) for k in found if k < len(ends) and k != own]
        if len(others) > 1:
            raise SurfaceError(
                f"{where}: more than two lines meet at E {ends[own, 0]:.2f} N {ends[own, 1]:.2f}; {advice}"
            )
        if others:
            partner[own] = others[0]
    tips = np.flatnonzero(partner < 0)
    if len(tips) != 2:
        raise SurfaceError(f"{where}: its {len(pieces)} lines are not one line with two ends; {advice}")
    at = int(tips[0])
    order: list[tuple[int, bool]] = []
    while True:
        order.append((at // 2, at % 2 == 1))
        far = at ^ 1
        if partner[far] < 0 or len(order) >= len(pieces):
            break
        at = int(partner[far])
    if len(order) < len(pieces):
        raise SurfaceError(f"{where}: its {len(pieces)} lines do not hang together; {advice}")
    directions = {turned for k, turned in order if not pieces[k].either_way}
    if len(directions) > 1:
        raise SurfaceError(
            f"{where}: its lines are drawn in different directions, so it does not say where stations begin; {advice}"
        )
    if directions == {True}:
        order = [(k, not turned) for k, turned in reversed(order)]
    return [e for k, turned in order for e in (pieces[k].turned() if turned else pieces[k].elements)]
