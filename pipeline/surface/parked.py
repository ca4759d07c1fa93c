"""Checks of the machine itself: shots of the cutting edge while it stood, and the bucket set on known points.

Ours minus total station in easting, northing and elevation, at a rest of the edge (`rests`). A shot that names left,
middle or right is compared with that point; another one with the nearest place on the edge's line, and then nothing is
said along the edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.surface.checks import COMPARED, Comparison
from pipeline.surface.rests import RestRule, Rests, nearest_rest, point_on, rests_of, stand_at
from pipeline.surface.shots import NO_TIME, Shots
from pipeline.tracks.poses import CuttingEdge

NO_CLOCK = "no time given"
NOT_STILL = "edge not still"
ELSEWHERE = "edge elsewhere"
NOT_SET_DOWN = "edge not set down"
FAR_M = 1.0
"""A shot further than this from the edge is of something else, or of another time."""
ONE_VISIT_S = 60.0
"""Rests on one known point that follow each other within this are one setting down; the longest counts."""


@dataclass(frozen=True)
class KnownPoint:
    """A point on which the bucket is set down."""

    p_grid: np.ndarray
    """(3,) easting, northing, elevation, grid metres."""
    sigma_m: float
    """Of each coordinate."""


def with_known_points(
    shots: Shots, known: Mapping[str, KnownPoint], edge: CuttingEdge, rests: Rests, radius_m: float
) -> Shots:
    """The shots with a row for every time the edge was set down on a known point.

    A control row of the file keeps its time; its coordinates are those of the known point with its id, if there is
    one. A control row without a time, and a known point that the file does not name, stand for every visit, or
    for one row without time where there was none.
    """
    rows: list[int] = []
    when: list[int] = []
    p = shots.p_grid.copy()
    sigma = shots.sigma_m.copy()
    for i in range(len(shots)):
        if shots.kind[i] != "control":
            rows.append(i)
            when.append(int(shots.time_ns[i]))
            continue
        if (point := known.get(str(shots.point[i]))) is not None:
            p[i], sigma[i] = point.p_grid, point.sigma_m
        times = [int(shots.time_ns[i])]
        if times[0] == NO_TIME:
            times = visits(edge, rests, p[i], radius_m) or [NO_TIME]
        rows += [i] * len(times)
        when += times
    at = np.array(rows, np.int64)
    named = {str(shots.point[i]) for i in range(len(shots)) if shots.kind[i] == "control"}
    more = [
        (name, point, time)
        for name, point in known.items()
        if name not in named
        for time in visits(edge, rests, point.p_grid, radius_m) or [NO_TIME]
    ]
    n = len(more)
    return Shots(
        point=_joined(shots.point[at], [name for name, _, _ in more]),
        code=_joined(shots.code[at], [""] * n),
        p_grid=np.concatenate([p[at], np.array([point.p_grid for _, point, _ in more]).reshape(n, 3)]),
        mended=shots.mended,
        kind=_joined(shots.kind[at], ["control"] * n),
        time_ns=np.concatenate([np.array(when, np.int64), np.array([t for _, _, t in more], np.int64)]),
        edge_point=_joined(shots.edge_point[at], [""] * n),
        sigma_m=np.concatenate([sigma[at], np.array([point.sigma_m for _, point, _ in more], float)]),
    )


def visits(edge: CuttingEdge, rests: Rests, p_grid: np.ndarray, radius_m: float) -> list[int]:
    """Times, ns, at which the edge rested on a point: the middle of the longest rest of each visit."""
    if not len(rests):
        return []
    middle = (rests.first + rests.stop) // 2
    points = edge.p_grid[middle]
    left, along = points[:, 0], points[:, 2] - points[:, 0]
    share = np.einsum("kj,kj->k", p_grid - left, along) / np.maximum(
        np.einsum("kj,kj->k", along, along), 1e-12
    )
    away = np.linalg.norm(left + np.clip(share, 0.0, 1.0)[:, None] * along - p_grid, axis=1)
    near = np.flatnonzero(away <= radius_m)
    if not len(near):
        return []
    begins, ends = edge.time_ns[rests.first[near]], edge.time_ns[rests.stop[near] - 1]
    groups = np.split(np.arange(len(near)), np.flatnonzero(begins[1:] - ends[:-1] > ONE_VISIT_S * 1e9) + 1)
    longest = [group[np.argmax((ends - begins)[group])] for group in groups]
    return [int(begins[k] + (ends[k] - begins[k]) // 2) for k in longest]


def compare_parked(
    comparison: Comparison,
    shots: Shots,
    edge: CuttingEdge,
    rests: Rests | None = None,
    radius_m: float = 0.15,
    tolerance_s: float = 5.0,
    correlation_s: float | None = None,
) -> Comparison:
    """The comparison with its rows of the edge and of known points filled in.

    Parameters
    ----------
    comparison : Comparison
        Of ``checks.compare`` for the same shots.
    shots : Shots
        Those of kind floor stay as they are.
    edge : CuttingEdge
        The whole log.
    rests : Rests, optional
        Of ``rests_of``.
    radius_m : float
        The edge rests on a known point within this.
    tolerance_s : float
        How far the total station's clock may be from that of the log.
    correlation_s : float, optional
        Over which the own part of a parked edge stays the same error.

    Returns
    -------
    Comparison
    """
    rests = rests_of(edge) if rests is None else rests
    found = replace(comparison, **{name: getattr(comparison, name).copy() for name in _FILLED})
    rule = RestRule()
    for i in np.flatnonzero(shots.kind != "floor"):
        control = shots.kind[i] == "control"
        if shots.time_ns[i] == NO_TIME:
            found.result[i] = NOT_SET_DOWN if control else NO_CLOCK
            continue
        which, away_ns = nearest_rest(edge, rests, int(shots.time_ns[i]))
        if which < 0 or away_ns > tolerance_s * 1e9:
            found.result[i] = NOT_STILL
            continue
        stand = stand_at(edge, rests, which, int(shots.time_ns[i]), correlation_s, rule)
        shot, name = shots.p_grid[i], str(shots.edge_point[i])
        ours, own, common = point_on(stand, name, shot)
        difference = ours - shot
        if np.linalg.norm(difference) > (radius_m if control and not name else FAR_M):
            found.result[i] = NOT_SET_DOWN if control else ELSEWHERE
            continue
        found.result[i], found.time_ns[i], found.edge_point[i] = COMPARED, stand.time_ns, name or "nearest"
        found.as_built_h[i] = ours[2]
        found.difference_e[i], found.difference_n[i], found.difference[i] = difference
        found.own[i], found.common[i] = own, common
        if not name:
            along = (stand.points[2] - stand.points[0])[:2]
            found.along_en[i] = along / max(float(np.linalg.norm(along)), 1e-12)
    return found


_FILLED = (
    "result", "time_ns", "edge_point", "as_built_h", "difference_e", "difference_n", "difference", "own", "common",
    "along_en",
)  # fmt: skip


def _joined(first: np.ndarray, more: list[str]) -> np.ndarray:
    return np.concatenate([first, np.array(more, object)])
