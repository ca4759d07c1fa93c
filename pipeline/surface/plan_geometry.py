"""From the elements of a file, LandXML or DXF, to an alignment in grid metres; what cannot be followed is refused."""

from __future__ import annotations

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment, from_elements
from pipeline.surface.landxml_alignments import XmlAlignment, XmlElement

MAX_LENGTH_M = 1_000_000.0
"""Of an alignment: it is sampled every 0.25 m, and a wrong number in a file must not ask for all memory."""
_LENGTH_M = 0.05
"""How far the stated length of an alignment may be from that of its elements; rounding adds up over many of them."""


def alignment_of(element: XmlAlignment, source: str, scale: float) -> Alignment:
    """The alignment of a file in grid metres. Raises SurfaceError for what cannot be followed.

    Station equations are refused: with them one station can be two places, and a table by station would name neither.
    """
    where = f"{source}: alignment '{element.name}'"
    foreign = sorted({e.kind for e in element.elements} - {"Line", "Curve", "Spiral"})
    if foreign:
        raise SurfaceError(
            f"{where} has elements of kind {', '.join(foreign)}; lines, arcs and spirals are understood: "
            "export it with them, or give [alignment] points in site.toml"
        )
    spirals = sorted(
        {e.spiral or "of no kind" for e in element.elements if e.kind == "Spiral"} - {"clothoid"}
    )
    if spirals:
        raise SurfaceError(
            f"{where} has spirals that are {', '.join(spirals)}; clothoids are understood: export it with them, or as "
            "a polyline"
        )
    if element.equations:
        raise SurfaceError(
            f"{where} has station equations, so its stations jump; export it with continuous stations"
        )
    if any(e.kind == "Curve" and e.center is None for e in element.elements):
        raise SurfaceError(f"{where} has an arc without Center; export it with centres")
    if any(e.kind == "Spiral" and e.length is None for e in element.elements):
        raise SurfaceError(f"{where} has a spiral without length; export it again")
    nowhere = (np.nan, np.nan)
    spiral = any(e.kind == "Spiral" for e in element.elements)
    alignment = from_elements(
        np.array([e.start for e in element.elements]) * scale,
        np.array([e.end for e in element.elements]) * scale,
        np.array([e.center if e.kind == "Curve" and e.center else nowhere for e in element.elements]) * scale,
        np.array([_turn(e) for e in element.elements]),
        element.start_station * scale,
        element.name,
        curvature=np.array([_curvature(e) for e in element.elements]) / scale if spiral else None,
        spiral_length=np.array([np.nan if e.length is None else e.length * scale for e in element.elements]),
    )
    if not alignment.length <= MAX_LENGTH_M:
        raise SurfaceError(
            f"{where} is {alignment.length / 1000:,.0f} km long; cut it down to the job, or is a coordinate wrong?"
        )
    if (
        element.stated_length is not None
        and abs(alignment.length - element.stated_length * scale) > _LENGTH_M
    ):
        raise SurfaceError(
            f"{where}: its elements are {alignment.length / scale:.3f} long, the file says "
            f"{element.stated_length:.3f}; export it again"
        )
    return alignment


def _turn(element: XmlElement) -> int:
    return 0 if element.kind == "Line" else (1 if element.clockwise else -1)


def _curvature(element: XmlElement) -> tuple[float, float]:
    """At start and end, positive to the right, 1 / unit of the file; nan unless a spiral."""
    if element.kind != "Spiral" or element.radii is None:
        return np.nan, np.nan
    sign = _turn(element)
    return sign / element.radii[0], sign / element.radii[1]


def without_spirals(line: Alignment, error_m: float) -> Alignment:
    """The same line with chords in place of its spirals, for formats and readers that know none.

    Parameters
    ----------
    line : Alignment
        Lines and arcs of it stay as they are, and so do all stations.
    error_m : float
        How far a chord may leave its spiral.
    """
    if line.curvature is None:
        return line
    borders: list[np.ndarray] = []
    for k, bend in enumerate(np.abs(line.curvature)):
        first, last = line.station[k], line.station[k + 1]
        chords = 1
        if np.isfinite(bend[0]):
            chords = max(1, int(np.ceil((last - first) * np.sqrt(bend.max() / (8 * error_m)))))
        borders.append(np.linspace(first, last, chords, endpoint=False))
    count = np.array([len(part) for part in borders])
    owner = np.repeat(np.arange(len(count)), count)
    station = np.append(np.concatenate(borders), line.station[-1])
    corners = line.points(station, 0.0)
    # Elements that stay keep their ends to the last digit.
    start, end = corners[:-1], corners[1:]
    alone = count[owner] == 1
    start[alone], end[alone] = line.start[owner[alone]], line.end[owner[alone]]
    spiral = np.isfinite(line.curvature[owner, 0])
    turn = np.where(spiral, 0, line.turn[owner]).astype(line.turn.dtype)
    return Alignment(start, end, line.center[owner], turn, station, line.name)
