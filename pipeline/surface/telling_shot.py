"""Which further shot would tell two causes apart that the check shots leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.sensitivities import Sensitivities
from pipeline.surface.alignment import Alignment
from pipeline.surface.as_built import AsBuilt
from pipeline.surface.diagnosis import Candidate
from pipeline.surface.shot_errors import causes_of, response_at, signature_of
from pipeline.tracks.poses import CuttingEdge

PLACES = 400
"""Places on the floor, and poses of the machine, that are tried."""
ENOUGH_SIGMAS = 3.0
"""A shot on which the two explanations differ by less tells little."""


@dataclass(frozen=True)
class TellingShot:
    """A shot on which two explanations differ, and what each of them lets one expect there, metres."""

    kind: str
    """floor, or edge: the cutting edge parked as it was at `time_ns`."""
    station: float
    offset: float
    time_ns: int
    axis: str
    """e, n or h: which difference tells."""
    first: float
    second: float
    apart_sigmas: float


def telling_shot(
    first: Candidate,
    second: Candidate,
    built: AsBuilt,
    alignment: Alignment,
    edge: CuttingEdge,
    answer: Sensitivities | None,
    sigma_ts_m: float,
) -> TellingShot | None:
    """The shot on which two explanations differ most, in sigmas of the shot and the own part; None where none tells.

    A shot of the floor is preferred if it is enough; parking the machine as it stood once takes a driver.
    """
    if answer is None:
        return None
    causes = causes_of(answer, in_plan=True)
    wanted = [causes.index(first.cause), causes.index(second.cause)]
    value = np.array([first.value, second.value])
    floor = _floor(built, alignment)
    tried = []
    if floor is not None:
        station, offset, when, place, own = floor
        up = np.tile([0.0, 0.0, 1.0], (len(when), 1))
        moved = response_at(answer, edge, when, place)
        expected = signature_of(causes, answer, moved, up, up)[:, wanted] * value
        k, apart = _widest(expected, np.hypot(own, sigma_ts_m))
        tried.append(
            TellingShot(
                "floor",
                float(station[k]),
                float(offset[k]),
                int(when[k]),
                "h",
                float(expected[k, 0]),
                float(expected[k, 1]),
                apart,
            )
        )
    rows = np.flatnonzero(edge.seen)
    rows = rows[(edge.time_ns[rows] >= answer.time_ns[0]) & (edge.time_ns[rows] <= answer.time_ns[-1])]
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), PLACES)).astype(int)] if len(rows) else rows
    if len(rows):
        middle = edge.p_grid[rows, 1]
        moved = response_at(answer, edge, edge.time_ns[rows], middle)
        station, offset = alignment.station_offset(middle[:, :2])
        for i, name in enumerate("enh"):
            u = np.tile(np.eye(3)[i], (len(rows), 1))
            expected = signature_of(causes, answer, moved, u, u)[:, wanted] * value
            own = np.sqrt(
                np.maximum(edge.cov[rows, 1, (0, 3, 5)[i]] - edge.common[rows, 1, (0, 3, 5)[i]], 0.0)
            )
            k, apart = _widest(expected, np.hypot(own, sigma_ts_m))
            when_ns = int(edge.time_ns[rows[k]])
            tried.append(
                TellingShot(
                    "edge",
                    float(station[k]),
                    float(offset[k]),
                    when_ns,
                    name,
                    float(expected[k, 0]),
                    float(expected[k, 1]),
                    apart,
                )
            )
    tried = [shot for shot in tried if shot.apart_sigmas >= ENOUGH_SIGMAS]
    if not tried:
        return None
    return tried[0] if tried[0].kind == "floor" else max(tried, key=lambda shot: shot.apart_sigmas)


def _floor(built: AsBuilt, alignment: Alignment):
    """One cell of the cut floor per row of cells, the one nearest to the axis."""
    cut = built.cut & built.floor
    rows = np.flatnonzero(cut.any(axis=1))
    if not len(rows):
        return None
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), PLACES)).astype(int)]
    columns = np.argmin(np.where(cut[rows], np.abs(built.grid.offset)[None, :], np.inf), axis=1)
    station, offset = built.grid.station[rows], built.grid.offset[columns]
    place = np.column_stack([alignment.points(station, offset), built.h[rows, columns]])
    return station, offset, built.lowest_time_ns[rows, columns], place, built.sigma_own[rows, columns]


def _widest(expected: np.ndarray, sigma: np.ndarray) -> tuple[int, float]:
    apart = np.abs(expected[:, 0] - expected[:, 1]) / sigma
    k = int(np.argmax(apart))
    return k, float(apart[k])
