"""One spiral of an alignment: a curve whose curvature grows evenly along it (a clothoid).

The integral of its direction has no closed form, so the curve is cut into short pieces whose starts are known to
rounding, and within a piece four Gauss points integrate the rest: with pieces that turn by less than 0.05 rad the
rule's own error is under 1e-15 of the length. That costs a few sines a point, so a million points take a second.

All points are metres from the spiral's own start: in grid coordinates, millions of metres, the search for the nearest
point would end in rounding. Curvatures and angles are counter-clockwise positive, as the plane's are; the alignment
turns them into its own sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

_GAUSS_AT, _GAUSS_WEIGHT = (0.5 * a for a in np.polynomial.legendre.leggauss(4))
_GAUSS_AT = _GAUSS_AT + 0.5
_TURN_OF_A_PIECE = 0.05
_LEAST_PIECES = 24
_STEPS = 60
"""Newton's rule takes three to six; where it has no footing, halving takes 40 to reach `_CLOSE_M`."""
_CLOSE_M = 1e-9
_LEAST_FOOTING = 0.05


@dataclass(frozen=True)
class Clothoid:
    """A clothoid that starts at 0, 0; build it with `clothoid_to`."""

    curvature: tuple[float, float]
    """At start and end, 1/m."""
    length: float
    """Along the curve, metres."""
    heading: float
    """Of its start, from the first axis, radians."""
    known: np.ndarray
    """(pieces + 1, 2) points at equal lengths along it, metres."""

    def walk(self, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and unit directions (n, 2) at lengths (n,) along it."""
        point, direction = np.empty((len(along), 2)), np.empty((len(along), 2))
        _walk_all(*self._shape, self.known, np.ascontiguousarray(along, np.float64), point, direction)
        return point, direction

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Lengths (n,) along it, from 0 to its own, of the nearest points of the curve to points (n, 2)."""
        along = np.empty(len(point))
        _nearest_all(*self._shape, self.known, np.ascontiguousarray(point, np.float64), along)
        return along

    def turned(self, along: float) -> float:
        """Heading at a length along it, radians."""
        return self.heading + float(_turned(*self.curvature, self.length, along))

    @property
    def _shape(self) -> tuple[float, float, float, float]:
        return (*self.curvature, self.length, self.heading)


def clothoid_to(end: np.ndarray, curvature: tuple[float, float], length: float) -> Clothoid:
    """The clothoid of these curvatures from 0, 0 to `end` (2,).

    Its length follows from the distance of the two points; the stated one is where the search starts, because a file
    rounds both and the points are what its neighbours join.
    """
    wanted = math.hypot(*end)
    for _ in range(_STEPS):
        reached = math.hypot(*_pieces(curvature, length)[-1])
        step = 1e-6 * length
        slope = (math.hypot(*_pieces(curvature, length + step)[-1]) - reached) / step
        change = (wanted - reached) / (slope if slope > _LEAST_FOOTING else 1.0)
        length += min(max(change, -0.1 * length), 0.1 * length)
        if abs(change) < _CLOSE_M:
            break
    pieces = _pieces(curvature, length)
    heading = math.atan2(end[1], end[0]) - math.atan2(pieces[-1, 1], pieces[-1, 0])
    c, s = math.cos(heading), math.sin(heading)
    return Clothoid(curvature, length, heading, pieces @ np.array([[c, s], [-s, c]]))


def _pieces(curvature: tuple[float, float], length: float) -> np.ndarray:
    """(pieces + 1, 2) points at equal lengths along a clothoid that starts at 0, 0 along the first axis."""
    turned = max(abs(curvature[0]), abs(curvature[1])) * length
    count = max(_LEAST_PIECES, math.ceil(turned / _TURN_OF_A_PIECE))
    spacing = length / count
    angle = _turned(*curvature, length, np.arange(count)[:, None] * spacing + _GAUSS_AT * spacing)
    step = np.stack([np.cos(angle) @ _GAUSS_WEIGHT, np.sin(angle) @ _GAUSS_WEIGHT], axis=-1) * spacing
    return np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])


@njit(cache=True, nogil=True)
def _turned(k0, k1, length, along):  # pragma: no cover - compiled
    return along * (k0 + 0.5 * (k1 - k0) * along / length)


@njit(cache=True, nogil=True)
def _walk(k0, k1, length, heading, known, along):  # pragma: no cover - compiled
    """Point and direction at a length along."""
    spacing = length / (len(known) - 1)
    piece = min(max(int(along / spacing), 0), len(known) - 2)
    begin = piece * spacing
    rest = along - begin
    x, y = known[piece, 0], known[piece, 1]
    for i in range(len(_GAUSS_AT)):
        angle = heading + _turned(k0, k1, length, begin + _GAUSS_AT[i] * rest)
        x += _GAUSS_WEIGHT[i] * rest * math.cos(angle)
        y += _GAUSS_WEIGHT[i] * rest * math.sin(angle)
    angle = heading + _turned(k0, k1, length, along)
    return x, y, math.cos(angle), math.sin(angle)


@njit(cache=True, nogil=True)
def _walk_all(k0, k1, length, heading, known, along, point, direction):  # pragma: no cover - compiled
    for i in range(len(along)):
        x, y, c, s = _walk(k0, k1, length, heading, known, along[i])
        point[i, 0], point[i, 1], direction[i, 0], direction[i, 1] = x, y, c, s


@njit(cache=True, nogil=True)
def _nearest_all(k0, k1, length, heading, known, point, out):  # pragma: no cover - compiled
    """The nearest known point tells the two pieces to search; there the way to the point is square to the curve."""
    spacing = length / (len(known) - 1)
    for i in range(len(point)):
        px, py = point[i, 0], point[i, 1]
        best, nearest = np.inf, 0
        for k in range(len(known)):
            squared = (px - known[k, 0]) ** 2 + (py - known[k, 1]) ** 2
            if squared < best:
                best, nearest = squared, k
        low = max(nearest - 1, 0) * spacing
        high = min(nearest + 1, len(known) - 1) * spacing
        along = nearest * spacing
        for _ in range(_STEPS):
            x, y, c, s = _walk(k0, k1, length, heading, known, along)
            ahead = (px - x) * c + (py - y) * s
            left = (py - y) * c - (px - x) * s
            if ahead > 0:
                low = along
            else:
                high = along
            # Newton's rule has no footing near the centre of curvature, and may leave the interval: halve it then.
            footing = 1.0 - (k0 + (k1 - k0) * along / length) * left
            moved = along + ahead / footing if footing > _LEAST_FOOTING else np.inf
            if not low <= moved <= high:
                moved = 0.5 * (low + high)
            change = abs(moved - along)
            along = moved
            if change < _CLOSE_M:
                break
        out[i] = along
