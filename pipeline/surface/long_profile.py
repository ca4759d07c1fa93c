"""Levels along an alignment: gradients between points of intersection, rounded by parabolas or circles; metres.

Where two gradients g1 and g2 (rise per run) meet, a parabola of horizontal length L begins L / 2 before the point of
intersection and changes the gradient evenly, by (g2 - g1) / L a metre. An unsymmetrical one is two parabolas that meet
under the point with one tangent. A circle of radius R touches both gradients R tan(d / 2) from the point, measured
along them, d being the angle between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.landxml_profiles import XmlProfile, XmlVertex

_OVERLAP_M = 0.001
_CHORD_M = 1e-6
_MAX_ROWS = 5_000_000
_LENGTH_SHARE = 0.01
"""How far the stated length of a circle may be from the one its radius makes: chord, arc and run differ by less."""


@dataclass(frozen=True)
class LongProfile:
    """Pieces end to end, each straight, a parabola or a circle; build it with `long_profile`."""

    station: np.ndarray
    """(m + 1,) borders of the pieces, ascending, metres."""
    level: np.ndarray
    """(m,) elevation at each piece's start, metres."""
    gradient: np.ndarray
    """(m,) rise per run at each piece's start."""
    growth: np.ndarray
    """(m,) of the gradient on a parabola, 1/m; 0 elsewhere."""
    radius: np.ndarray
    """(m,) of a circle, positive in a sag, negative on a crest, metres; nan elsewhere."""

    def elevation(self, station: np.ndarray) -> np.ndarray:
        """Elevation (...) at stations (...); nan before the first and after the last."""
        return self._at(station)[0]

    def slope(self, station: np.ndarray) -> np.ndarray:
        """Gradient (...) at stations (...), rise per run; nan before the first and after the last."""
        return self._at(station)[1]

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Stations and elevations (n,), so close that straight lines between them are right to a micrometre.

        Raises SurfaceError where that takes millions of rows: no trench is that long.
        """
        stations: list[np.ndarray] = []
        rows = 0
        for k in range(len(self.level)):
            first, last = self.station[k], self.station[k + 1]
            # A chord of a curve that bends by c a metre leaves it by c s^2 / 8; a circle bends by (1 + g^2)^1.5 / R.
            steep = max(1.0, *(1 + self.slope(np.array([first, last])) ** 2)) ** 1.5
            bend = max(abs(self.growth[k]), 0.0 if np.isnan(self.radius[k]) else steep / abs(self.radius[k]))
            count = max(1, math.ceil((last - first) / math.sqrt(8 * _CHORD_M / bend))) if bend > 0 else 1
            rows += count
            if rows > _MAX_ROWS:
                raise SurfaceError(
                    f"a profile of {(self.station[-1] - self.station[0]) / 1000:.0f} km is too long to be followed; "
                    "cut it down to the job"
                )
            stations.append(np.linspace(first, last, count, endpoint=False))
        station = np.concatenate([*stations, self.station[-1:]])
        return station, self.elevation(station)

    def _at(self, station: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        station = np.asarray(station, float)
        piece = np.clip(np.searchsorted(self.station, station, side="right") - 1, 0, len(self.level) - 1)
        run = station - self.station[piece]
        gradient = self.gradient[piece] + self.growth[piece] * run
        level = self.level[piece] + run * (self.gradient[piece] + 0.5 * self.growth[piece] * run)
        radius = self.radius[piece]
        circle = np.isfinite(radius)
        if np.any(circle):
            # Along a circle the sine of the gradient's angle grows evenly, by 1 / R a metre of run.
            start = np.arctan(self.gradient[piece])
            sine = np.clip(np.sin(start) + run / np.where(circle, radius, np.inf), -1.0, 1.0)
            cosine = np.sqrt(1.0 - sine**2)
            level = np.where(circle, self.level[piece] + radius * (np.cos(start) - cosine), level)
            gradient = np.where(circle, sine / np.maximum(cosine, 1e-12), gradient)
        outside = (station < self.station[0]) | (station > self.station[-1])
        return np.where(outside, np.nan, level), np.where(outside, np.nan, gradient)


@dataclass(frozen=True)
class _Rounding:
    """A curve at one point of intersection: its pieces by (run, growth, radius), and how far they reach."""

    before: float
    after: float
    pieces: tuple[tuple[float, float, float], ...]


def long_profile(profile: XmlProfile, source: str, scale: float) -> LongProfile:
    """The levels of a LandXML profile.

    Parameters
    ----------
    profile : XmlProfile
        In the unit of its file.
    source : str
        For messages.
    scale : float
        Metres per unit of the file.

    Raises
    ------
    SurfaceError
        When stations do not ascend, curves overlap or do not fit, or there are gaps.
    """
    where = f"{source}: profile '{profile.name}'"
    if profile.gaps:
        raise SurfaceError(f"{where} has {profile.gaps + 1} separate stretches; export the one of this job")
    vertices = profile.vertices
    station = np.array([v.station for v in vertices]) * scale
    level = np.array([v.elevation for v in vertices]) * scale
    if len(vertices) < 2:
        raise SurfaceError(f"{where} has one point only; two are needed")
    bad = np.flatnonzero(np.diff(station) <= 0)
    if len(bad):
        raise SurfaceError(
            f"{where}: stations must grow from point to point; {vertices[bad[0] + 1].station:g} follows "
            f"{vertices[bad[0]].station:g}"
        )
    gradient = np.diff(level) / np.diff(station)
    roundings = [_Rounding(0.0, 0.0, ())]
    for k in range(1, len(vertices) - 1):
        at = f"{where}: the {vertices[k].kind} at station {vertices[k].station:g}"
        roundings.append(_rounding(vertices[k], float(gradient[k - 1]), float(gradient[k]), scale, at))
    roundings.append(_Rounding(0.0, 0.0, ()))
    for k in (0, -1):
        if vertices[k].kind != "PVI" and any(
            (vertices[k].length_in, vertices[k].length_out, vertices[k].radius)
        ):
            raise SurfaceError(
                f"{where}: its {'first' if k == 0 else 'last'} point is a {vertices[k].kind}, which has a gradient on "
                "one side only; export the profile with a point beyond it"
            )
    borders, levels, gradients, growths, radii = [station[0]], [], [], [], []
    for k, slope in enumerate(gradient):
        here, there = roundings[k], roundings[k + 1]
        first, last = station[k] + here.after, station[k + 1] - there.before
        if last < first - _OVERLAP_M:
            raise SurfaceError(
                f"{where}: the curves at stations {vertices[k].station:g} and {vertices[k + 1].station:g} overlap by "
                f"{(first - last) / scale:.3f}; export the profile again"
            )
        if last > first + 1e-9:
            levels.append(level[k] + slope * here.after)
            gradients.append(slope)
            growths.append(0.0)
            radii.append(np.nan)
            borders.append(last)
        # The curve starts on the tangent, wherever the straight before it ended.
        at, height, incline = last, level[k + 1] - slope * there.before, slope
        for run, growth, radius in there.pieces:
            levels.append(height)
            gradients.append(incline)
            growths.append(growth)
            radii.append(radius)
            at += run
            borders.append(at)
            height += run * (incline + 0.5 * growth * run)
            incline += growth * run
    return LongProfile(*(np.array(a, float) for a in (borders, levels, gradients, growths, radii)))


def _rounding(vertex: XmlVertex, g1: float, g2: float, scale: float, where: str) -> _Rounding:
    """The curve at a point of intersection between gradients g1 and g2; lengths in metres from here on."""
    if vertex.kind == "CircCurve":
        return _circle(vertex, g1, g2, scale, where)
    before, after = (vertex.length_in or 0.0) * scale, (vertex.length_out or 0.0) * scale
    if before < 0 or after < 0:
        raise SurfaceError(f"{where} has a negative length; export it again")
    if before == 0 or after == 0:  # two parabolas of which one has no length cannot share a tangent: a corner
        return _Rounding(0.0, 0.0, ())
    if before == after:
        return _Rounding(before, after, ((before + after, (g2 - g1) / (before + after), np.nan),))
    # Both parabolas have the gradient g under the point; their ends are on the tangents only with this one.
    g = (before * g1 + after * g2) / (before + after)
    halves = [(before, g - g1), (after, g2 - g)]
    return _Rounding(before, after, tuple((run, turn / run, np.nan) for run, turn in halves))


def _circle(vertex: XmlVertex, g1: float, g2: float, scale: float, where: str) -> _Rounding:
    assert vertex.radius is not None
    radius = abs(vertex.radius) * scale
    first, last = math.atan(g1), math.atan(g2)
    tangent = radius * math.tan(0.5 * abs(last - first))
    if vertex.length is not None:
        arc = radius * abs(last - first)
        if abs(vertex.length * scale - arc) > max(_LENGTH_SHARE * arc, 0.01):
            raise SurfaceError(
                f"{where} is stated as {vertex.length:.3f} long, but its radius makes it {arc / scale:.3f}; export it "
                "again"
            )
    if tangent == 0:
        return _Rounding(0.0, 0.0, ())
    before, after = tangent * math.cos(first), tangent * math.cos(last)
    return _Rounding(before, after, ((before + after, 0.0, math.copysign(radius, g2 - g1)),))
