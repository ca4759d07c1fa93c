"""Station and offset along an alignment of straight lines, arcs and spirals, there and back; grid metres.

Stations run along the alignment from its start station; offsets are to the right of it, positive to the right when
looking along increasing station. Before the first and after the last point the end tangents go on, so that a point
out there has a station outside ``[start, end]`` and can be told from one inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.clothoid import Clothoid, clothoid_to

# Consecutive points of a sweep lie together: one bounding circle rules out most elements for a chunk.
_CHUNK = 4096
_JOINT_TOLERANCE_M = 0.005
_KINK_RAD = 0.02
"""At a spiral's ends; rounded coordinates bend it by 0.001. More is a turn the wrong way, or radii in wrong order."""
_END_M = 1e-8


@dataclass(frozen=True)
class Alignment:
    """Elements end to end; build it with `polyline` or `from_elements`."""

    start: np.ndarray
    """(m, 2) easting, northing of each element's start, metres."""
    end: np.ndarray
    """(m, 2) of each element's end."""
    center: np.ndarray
    """(m, 2) of the arc's centre; nan for a line and for a spiral."""
    turn: np.ndarray
    """(m,) -1 turns left (counter-clockwise), +1 turns right (clockwise), 0 is a straight line. Spirals turn too."""
    station: np.ndarray
    """(m + 1,) stations of the elements' borders, metres."""
    name: str = ""
    curvature: np.ndarray | None = None
    """(m, 2) at the start and end of spirals, 1/m, positive to the right; nan for other elements. None: no spirals."""

    @property
    def start_station(self) -> float:
        return float(self.station[0])

    @property
    def end_station(self) -> float:
        return float(self.station[-1])

    @property
    def length(self) -> float:
        return self.end_station - self.start_station

    def points(self, station: np.ndarray, offset: np.ndarray | float) -> np.ndarray:
        """Easting and northing of points given by station and offset.

        Parameters
        ----------
        station, offset : (...,) arrays
            Metres; they broadcast. Stations outside the alignment lie on its end tangents.

        Returns
        -------
        (..., 2) array
            Grid metres.
        """
        station, offset = np.broadcast_arrays(np.asarray(station, float), np.asarray(offset, float))
        element = np.clip(np.searchsorted(self.station, station, side="right") - 1, 0, len(self.turn) - 1)
        along = station - self.station[element]
        length = np.diff(self.station)[element]
        # On an arc the end tangent goes on straight: walk the arc to its end, the rest along the tangent.
        inside = np.clip(along, 0.0, length)
        foot, direction = self._walk(element, inside)
        foot = foot + (along - inside)[..., None] * direction
        right = np.stack([direction[..., 1], -direction[..., 0]], axis=-1)
        return foot + offset[..., None] * right

    def station_offset(self, en: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Station and offset of points: those of the nearest point of the alignment.

        Parameters
        ----------
        en : (..., 2) array
            Easting, northing, grid metres.

        Returns
        -------
        station, offset : (...,) arrays
            Metres; offset is positive to the right.
        """
        en = np.asarray(en, dtype=np.float64)
        flat = en.reshape(-1, 2)
        station, offset = np.empty(len(flat)), np.empty(len(flat))
        for begin in range(0, len(flat), _CHUNK):
            rows = slice(begin, begin + _CHUNK)
            station[rows], offset[rows] = self._nearest(flat[rows])
        return station.reshape(en.shape[:-1]), offset.reshape(en.shape[:-1])

    def directions(self, element: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Unit vectors (..., 2) along the alignment at lengths (...,) along elements (...,)."""
        return self._walk(element, along)[1]

    def _walk(self, element: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and unit directions at lengths along elements; (..., 2) each."""
        start, end, center = self.start[element], self.end[element], self.center[element]
        turn = self.turn[element].astype(float)
        length = np.diff(self.station)[element]
        arc = (turn != 0) & np.isfinite(center[..., 0])
        line_direction = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
        foot = start + along[..., None] * line_direction
        direction = line_direction
        if np.any(arc):
            radial = start - center
            radius = np.linalg.norm(radial, axis=-1)
            sweep = np.where(
                arc, -turn * along / np.where(arc, radius, 1.0), 0.0
            )  # counter-clockwise positive
            cos, sin = np.cos(sweep), np.sin(sweep)
            turned = np.stack(
                [cos * radial[..., 0] - sin * radial[..., 1], sin * radial[..., 0] + cos * radial[..., 1]],
                axis=-1,
            )
            tangent = (
                -turn[..., None]
                * np.stack([-turned[..., 1], turned[..., 0]], axis=-1)
                / np.where(arc, radius, 1.0)[..., None]
            )
            foot = np.where(arc[..., None], center + turned, foot)
            direction = np.where(arc[..., None], tangent, direction)
        for k, spiral in self._spirals.items():
            here = element == k
            if np.any(here):
                point, direction[here] = spiral.walk(along[here])
                foot[here] = self.start[k] + point
        assert length.shape == along.shape
        return foot, direction

    def _nearest(self, en: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Bounds on the distance of each element's middle circle rule out those that cannot be nearest.
        center = 0.5 * (en.min(axis=0) + en.max(axis=0))
        reach = np.max(np.linalg.norm(en - center, axis=1))
        element_center, element_reach = self._circles()
        nearest_possible = np.linalg.norm(element_center - center, axis=1) - element_reach - reach
        surely_within = np.min(np.linalg.norm(self.start - center, axis=1)) + reach
        candidates = np.flatnonzero(nearest_possible <= surely_within)

        best = np.full(len(en), np.inf)
        station, offset = np.empty(len(en)), np.empty(len(en))
        for k in candidates:
            along, foot, direction = self._foot(int(k), en)
            length = self.station[k + 1] - self.station[k]
            away = en - foot
            distance = np.hypot(away[:, 0], away[:, 1])
            nearer = distance < best
            best[nearer] = distance[nearer]
            # At a corner the side is told by the bisector of both tangents; either one alone is wrong behind a
            # corner sharper than 90 degrees.
            side = away[:, 0] * direction[:, 1] - away[:, 1] * direction[:, 0]
            # Exactly the border's station at an end, so that who is nearest to one can be told.
            station[nearer] = np.where(along >= length, self.station[k + 1], self.station[k] + along)[nearer]
            offset[nearer] = np.where(side < 0, -distance, distance)[nearer]
        # Only what is nearest to an end goes on along its tangent: the tangent may cross the alignment elsewhere.
        final = len(self.turn) - 1
        for at, element, sign in ((self.start_station, 0, -1.0), (self.end_station, final, 1.0)):
            rows = np.flatnonzero(station == at)
            along = np.array([0.0 if sign < 0 else self.station[-1] - self.station[-2]])
            end, tangent = self._walk(np.array([element]), along)
            away = en[rows] - end[0]
            beyond = away @ tangent[0]
            out = beyond * sign > 0
            station[rows[out]] = at + beyond[out]
            offset[rows[out]] = (away[:, 0] * tangent[0, 1] - away[:, 1] * tangent[0, 0])[out]
        return station, offset

    @cached_property
    def _spirals(self) -> dict[int, Clothoid]:
        if self.curvature is None:
            return {}
        return {
            int(k): clothoid_to(
                self.end[k] - self.start[k],
                (-float(self.curvature[k, 0]), -float(self.curvature[k, 1])),
                float(self.station[k + 1] - self.station[k]),
            )
            for k in np.flatnonzero(np.isfinite(self.curvature[:, 0]))
        }

    def _circles(self) -> tuple[np.ndarray, np.ndarray]:
        length = np.diff(self.station)
        middle, _ = self._walk(np.arange(len(self.turn)), 0.5 * length)
        # No point of an element is further from its middle than half its length.
        return middle, 0.5 * length

    def _foot(self, k: int, en: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nearest point of element k: length along it, point (n, 2), direction for telling the side (n, 2)."""
        length = float(self.station[k + 1] - self.station[k])
        first, last = k == 0, k == len(self.turn) - 1
        ends, tangents = self._walk(np.array([k, k]), np.array([0.0, length]))
        if spiral := self._spirals.get(k):
            along = spiral.nearest(en - self.start[k])
            along = np.where(along < _END_M, 0.0, np.where(along > length - _END_M, length, along))
        elif self.turn[k] == 0:
            along = (en - ends[0]) @ tangents[0]
        else:
            radial = en - self.center[k]
            start = self.start[k] - self.center[k]
            radius = float(np.hypot(*start))
            swept = np.arctan2(start[0] * radial[:, 1] - start[1] * radial[:, 0], radial @ start)
            swept *= -float(self.turn[k])
            # The angle is only known modulo a turn: take the one nearest to the arc's middle.
            middle = 0.5 * length / radius
            along = (swept - 2 * np.pi * np.round((swept - middle) / (2 * np.pi))) * radius
        inside = np.clip(along, 0.0, length)
        foot, direction = self._walk(np.full(len(en), k), inside)
        if not first:
            corner = tangents[0] + self._tangent(k - 1, at_end=True)
            direction = np.where((along <= 0.0)[:, None], corner, direction)
        if not last:
            corner = tangents[1] + self._tangent(k + 1, at_end=False)
            direction = np.where((along >= length)[:, None], corner, direction)
        return inside, foot, direction

    def check_spirals(self) -> None:
        """Raise SurfaceError where a spiral leaves its neighbour's direction."""
        for k in self._spirals:
            for before, after in ((k - 1, k), (k, k + 1)):
                if before < 0 or after >= len(self.turn):
                    continue
                a, b = self._tangent(before, at_end=True), self._tangent(after, at_end=False)
                kink = abs(float(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)))
                if kink > _KINK_RAD:
                    raise SurfaceError(
                        f"alignment '{self.name}': elements {before + 1} and {after + 1} meet at an angle of "
                        f"{np.degrees(kink):.1f} degrees although one is a spiral; are its rot and radii right?"
                    )

    def _tangent(self, k: int, at_end: bool) -> np.ndarray:
        along = float(self.station[k + 1] - self.station[k]) if at_end else 0.0
        return self._walk(np.array([k]), np.array([along]))[1][0]


def polyline(points_en: np.ndarray, start_station_m: float = 0.0, name: str = "") -> Alignment:
    """Alignment through points by straight lines.

    Parameters
    ----------
    points_en : (n, 2) array
        Easting, northing, grid metres; n >= 2.
    start_station_m : float
        Station of the first point.
    name : str
        For messages.

    Raises
    ------
    SurfaceError
        When two successive points are the same.
    """
    points = np.asarray(points_en, dtype=np.float64)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if np.any(length < 1e-6):
        k = int(np.argmin(length))
        raise SurfaceError(
            f"alignment {name or 'of site.toml'}: points {k + 1} and {k + 2} are the same; remove one of them"
        )
    m = len(length)
    return Alignment(
        start=points[:-1],
        end=points[1:],
        center=np.full((m, 2), np.nan),
        turn=np.zeros(m, dtype=np.int8),
        station=start_station_m + np.concatenate([[0.0], np.cumsum(length)]),
        name=name,
    )


def from_elements(
    start: np.ndarray,
    end: np.ndarray,
    center: np.ndarray,
    turn: np.ndarray,
    start_station_m: float,
    name: str,
    tolerance_m: float = _JOINT_TOLERANCE_M,
    curvature: np.ndarray | None = None,
    spiral_length: np.ndarray | None = None,
) -> Alignment:
    """Alignment of lines, arcs and spirals given by their points.

    Parameters
    ----------
    start, end, center : (m, 2) arrays
        Grid metres; center is nan for a line and for a spiral.
    turn : (m,) array
        -1 left, +1 right, 0 line.
    start_station_m : float
        Station of the first element's start.
    name : str
        For messages.
    tolerance_m : float
        How far an element may start from the end of the one before, an arc's two radii may differ, and a spiral's
        length may differ from what its ends and radii make it.
    curvature : (m, 2) array, optional
        At start and end of spirals, 1/m, positive to the right; nan for other elements.
    spiral_length : (m,) array, optional
        As stated, metres; nan for other elements.

    Raises
    ------
    SurfaceError
        When elements do not join, an arc's end is not on its circle, a spiral does not fit between its ends or
        neighbours, or an element has no length.
    """
    start, end, center = (np.asarray(a, dtype=np.float64).reshape(-1, 2) for a in (start, end, center))
    turn = np.asarray(turn, dtype=np.int8)
    gap = np.linalg.norm(start[1:] - end[:-1], axis=1)
    if np.any(gap > tolerance_m):
        k = int(np.argmax(gap))
        raise SurfaceError(
            f"alignment '{name}': element {k + 2} starts {gap[k]:.3f} m from the end of element {k + 1}; "
            "export it again as one chain"
        )
    chord = np.linalg.norm(end - start, axis=1)
    arc = (turn != 0) & np.isfinite(center[:, 0])
    radius = np.where(arc, np.linalg.norm(start - center, axis=1), np.nan)
    other = np.where(arc, np.linalg.norm(end - center, axis=1), np.nan)
    if np.any(np.abs(radius - other)[arc] > tolerance_m):
        k = int(np.flatnonzero(arc)[np.argmax(np.abs(radius - other)[arc])])
        raise SurfaceError(
            f"alignment '{name}': the start and the end of arc {k + 1} are {radius[k]:.3f} m and {other[k]:.3f} m "
            "from its centre; export it again"
        )
    if np.any(chord < 1e-9):
        raise SurfaceError(
            f"alignment '{name}': element {int(np.argmin(chord)) + 1} has no length; remove it"
        )
    a, b = start - center, end - center
    # Counter-clockwise angle from start to end in [0, 2 pi), then the way round that the arc says.
    angle = np.mod(np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.sum(a * b, axis=1)), 2 * np.pi)
    angle = np.where(turn > 0, 2 * np.pi - angle, angle)
    length = np.where(arc, radius * angle, chord)
    if curvature is not None and spiral_length is not None:
        for k in map(int, np.flatnonzero(np.isfinite(curvature[:, 0]))):
            length[k] = _spiral_length(
                end[k] - start[k],
                curvature[k],
                spiral_length[k],
                tolerance_m,
                f"alignment '{name}': spiral {k + 1}",
            )
    alignment = Alignment(
        start=start,
        end=end,
        center=center,
        turn=turn,
        station=start_station_m + np.concatenate([[0.0], np.cumsum(length)]),
        name=name,
        curvature=curvature,
    )
    alignment.check_spirals()
    return alignment


def _spiral_length(
    chord: np.ndarray, curvature: Sequence[float], stated: float, tolerance_m: float, where: str
) -> float:
    """Length of the spiral over a chord (2,). Raises SurfaceError where it is not the stated one."""
    k0, k1 = -float(curvature[0]), -float(curvature[1])
    if not stated > 0:
        raise SurfaceError(f"{where} has no length; remove it")
    if (
        max(abs(k0), abs(k1)) * stated > np.pi
    ):  # beyond that the distance of its ends no longer tells its length
        raise SurfaceError(f"{where} turns by more than half a circle with its radii; are they right?")
    fitted = clothoid_to(chord, (k0, k1), stated).length
    if abs(fitted - stated) > tolerance_m:
        raise SurfaceError(
            f"{where} is stated as {stated:.3f} m long, but with its radii it takes {fitted:.3f} m from its start to "
            "its end; export it again"
        )
    return fitted
