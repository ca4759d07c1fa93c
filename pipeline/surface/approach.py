"""Closest approach of the moving cutting edge to lines in the ground: compiled, and within a stated error.

The edge is the polyline left, middle, right; a line is a chain of straight segments with a radius each. Between two
epochs that are both seen and no further apart than `SweepSettings.max_step_s` the edge moves as the sweep has it: along
a cubic where the step is long, straight where it is short. No place on the edge moves faster than the fastest of the
control points of that motion, so its distance from anything changes no faster; halving steps until nothing nearer can
hide in them finds the smallest distance within `ERROR_M`, however fast the pass. The same bound skips the hours in
which the edge is far away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.surface.distance_bound import quantiles
from pipeline.surface.nearest import COLUMNS, control_points, dip, measured, nearest, on_the_way, steps
from pipeline.surface.sweep import SweepSettings
from pipeline.tracks.poses import CuttingEdge

PAUSE_S = 2.0
"""Two approaches are one where the edge was out of the clearance for less than this in between."""
KEPT = 50
"""Approaches kept of each line, the lowest bounds first; all are counted."""
_SPREAD = 2.5
"""No bound lies more than this many of the largest sigma below its estimate: 2.448 of it at most."""

Motion = tuple[np.ndarray, np.ndarray, np.ndarray, int]
"""Times, places of the edge, which steps are swept, and how long one must be to be bent."""


@dataclass(frozen=True)
class Line:
    """Straight segments of one buried line; m >= 1."""

    start: np.ndarray
    """(m, 3) easting, northing, elevation of each segment's start on the axis, grid metres."""
    end: np.ndarray
    """(m, 3)."""
    radius: np.ndarray
    """(m,) from the axis to the surface, metres."""
    sigma_horizontal: float
    """Of the axis along any horizontal direction, the same error all along the line, metres."""
    sigma_vertical: float
    clearance: float
    """A bound below this makes an approach, metres."""


@dataclass(frozen=True)
class Instants:
    """Where the edge was nearest to a line at some instants; arrays (a,) unless said otherwise."""

    time_ns: np.ndarray
    """int64; between two epochs where the edge was nearest there."""
    edge: np.ndarray
    """(a, 3) the nearest place of the edge, grid metres."""
    axis: np.ndarray
    """(a, 3) the nearest place of the line's axis."""
    distance: np.ndarray
    """From the line's surface, metres; negative inside."""
    sigma_own: np.ndarray
    """Standard deviation of the distance, own part of the edge's error, metres."""
    sigma_common: np.ndarray
    """Common part of the edge's error."""
    sigma_line: np.ndarray
    """From the place of the line."""
    bound: np.ndarray
    """The distance is not below this, with 95 % confidence."""


@dataclass(frozen=True)
class Approaches:
    """What one line saw of the edge."""

    closest: Instants | None
    """(1,) at the smallest distance of the whole log; None where the edge was never seen."""
    events: Instants
    """At the smallest distance of each approach with a bound below the clearance, lowest bound first, at most `KEPT`;
    `bound` is the lowest of the approach."""
    start_ns: np.ndarray
    """(a,) first instant of each with a bound below the clearance."""
    end_ns: np.ndarray
    """(a,) last one."""
    inside: int
    """Approaches with a distance of 0 or less, all of them."""
    touching: int
    """Others with a bound of 0 or less."""
    near: int
    """Others with a bound below the clearance."""
    unseen: int
    """Stretches without a seen epoch that began, went on or ended within reach."""
    unseen_s: float
    """Seconds of them in all."""
    longest_unseen_s: float
    longest_unseen_ns: int
    """When the longest began."""


def approaches(
    edge: CuttingEdge, lines: list[Line], reach_m: float, settings: SweepSettings | None = None
) -> list[Approaches]:
    """How near the edge came to each line, every time it came near, and when it was not seen near it.

    Parameters
    ----------
    edge : CuttingEdge
        The whole log, grid metres.
    lines : list of Line
        What lies in the ground.
    reach_m : float
        Distance from a line's surface within which stretches count in which the edge was not seen.
    settings : SweepSettings, optional
        Its `max_step_s` and `interpolation_s`.

    Returns
    -------
    list of Approaches
        One per line.
    """
    settings = settings or SweepSettings()
    if not len(edge) or not lines:
        return [_nothing() for _ in lines]
    p = np.ascontiguousarray(edge.p_grid)
    bend_ns = round(settings.interpolation_s * 1e9)
    swept, travel, spread = steps(
        edge.time_ns, p, edge.seen, edge.cov, round(settings.max_step_s * 1e9), bend_ns
    )
    motion = (edge.time_ns, p, swept, bend_ns)
    box = np.array([(p[..., axis].min(), p[..., axis].max()) for axis in range(3)])
    return [
        _of_line(
            edge,
            motion,
            travel,
            spread,
            _segments(edge, box, float(spread.max()), line, reach_m),
            line,
            reach_m,
        )
        for line in lines
    ]


def _nothing() -> Approaches:
    none, never = np.zeros(0), np.zeros(0, np.int64)
    instants = Instants(never, *[np.zeros((0, 3))] * 2, *[none] * 5)
    return Approaches(None, instants, never, never, 0, 0, 0, 0, 0.0, 0.0, 0)


def _of_line(
    edge: CuttingEdge,
    motion: Motion,
    travel: np.ndarray,
    spread: np.ndarray,
    segments: np.ndarray,
    line: Line,
    reach_m: float,
) -> Approaches:
    h, v = line.sigma_horizontal**2, line.sigma_vertical**2
    times, rows, counts, unseen = _follow(
        *motion, edge.seen, travel, spread, edge.cov, edge.common, segments, np.array([h, 0.0, 0.0, h, 0.0, v]),
        quantiles(), line.clearance, reach_m, round(PAUSE_S * 1e9), KEPT,
    )  # fmt: skip
    order = 1 + np.argsort(rows[1:, COLUMNS - 1], kind="stable")
    return Approaches(
        closest=_instants(times[:1], rows[:1]) if times[0, 2] else None,
        events=_instants(times[order], rows[order]),
        start_ns=times[order, 0],
        end_ns=times[order, 1],
        inside=int(counts[0]),
        touching=int(counts[1]),
        near=int(counts[2]),
        unseen=int(unseen[0]),
        unseen_s=float(unseen[1] * 1e-9),
        longest_unseen_s=float(unseen[2] * 1e-9),
        longest_unseen_ns=int(unseen[3]),
    )


def _instants(times: np.ndarray, rows: np.ndarray) -> Instants:
    return Instants(
        times[:, 2], rows[:, :3], rows[:, 3:6], *(np.ascontiguousarray(rows[:, i]) for i in range(6, COLUMNS))
    )


def _segments(edge: CuttingEdge, box: np.ndarray, spread: float, line: Line, reach_m: float) -> np.ndarray:
    """Segments (m, 11) that can be the nearest one or within reach: of a town's sewers those beside the job."""
    apart = np.maximum(
        box[:, 0] - np.maximum(line.start, line.end), np.minimum(line.start, line.end) - box[:, 1]
    )
    at_least = np.linalg.norm(np.maximum(apart, 0.0), axis=1) - line.radius
    # The edge's way as a whole is no further from a line than one seen place of it is from one point of that line.
    one = edge.p_grid[int(np.argmax(edge.seen)), 1]
    at_most = float(np.min(np.linalg.norm(line.start - one, axis=1) - line.radius))
    wide = _SPREAD * float(np.hypot(spread, max(line.sigma_horizontal, line.sigma_vertical)))
    keep = at_least <= max(at_most, reach_m, line.clearance + wide)
    start, end, radius = line.start[keep], line.end[keep], line.radius[keep]
    half = 0.5 * np.linalg.norm(end - start, axis=1)
    return np.column_stack([start, end, 0.5 * (start + end), half, radius])


@njit(cache=True, nogil=True)
def _follow(
    time_ns, p, swept, bend_ns, seen, travel, spread, cov, common, segments, variance, table,
    clearance, reach, pause_ns, kept,
):  # fmt: skip  # pragma: no cover - compiled
    """One run over the log.

    Returns
    -------
    times, rows : (1 + a, 3) and (1 + a, `COLUMNS`) arrays
        First and last instant of each approach, its nearest one, and `measured` there; in front the nearest instant
        of the whole log, its time 0 where there is none. The bound of an approach is the lowest in it.
    counts : (3,) array
        Approaches with a distance of 0 or less, others with such a bound, the rest.
    unseen : (4,) array
        Unseen stretches within reach: how many, nanoseconds in all, of the longest, and its start.
    """
    n = len(time_ns)
    times, rows = np.zeros((1 + kept, 3), np.int64), np.zeros((1 + kept, COLUMNS))
    counts, unseen, number = np.zeros(3, np.int64), np.zeros(4, np.int64), 0
    control, edge, at = np.empty((4, 3, 3)), np.empty((3, 3)), np.zeros(4)
    span, event, row = np.zeros(3, np.int64), np.empty(COLUMNS), np.empty(COLUMNS)
    going = blind = blind_near = False
    blind_from, best, event_low, event_bound = time_ns[0], np.inf, np.inf, np.inf
    of_line = max(variance[0], variance[5])
    # The distance at the epoch before, inf if nobody asked; and what the distance has not gone below since.
    before, at_least = np.inf, -np.inf
    for k in range(n + 1):
        if going and (k == n or time_ns[k] - span[1] > pause_ns):
            number = _keep(span, event, times, rows, counts, number)
            going, event_low = False, np.inf
        if k == n:
            break
        wide = spread[k]
        if k > 0:
            at_least -= travel[k - 1]
            wide = max(wide, spread[k - 1])
        wide = _SPREAD * np.sqrt(wide * wide + of_line)
        here, wanted, passed = np.inf, max(clearance + wide, best), False
        if not swept[k] or (k > 0 and not swept[k - 1]):  # unseen stretches begin or end here, or go on
            wanted = max(wanted, reach)
        if at_least < wanted:
            if before == np.inf and k > 0:
                before = nearest(p[k - 1], segments, at)
            here = nearest(p[k], segments, at)
            at_least = here
            for turn in range(2):
                if turn == 0:  # the step to this epoch
                    covered = k > 0 and swept[k - 1]
                    enough = max(best, min(event_low, clearance + wide)) if covered else reach
                    if k == 0 or 0.5 * (before + here - travel[k - 1]) >= enough:
                        continue
                    control_points(k - 1, time_ns, p, swept, bend_ns, control)
                    low, u = dip(control, before, here, enough, segments, at)
                    epoch, now = k - 1, time_ns[k - 1] + int(u * (time_ns[k] - time_ns[k - 1]))
                    passed = not covered and low < reach  # on the straight way of a stretch without sight
                    if not covered or not 0.0 < u < 1.0:
                        continue
                    on_the_way(control, u, edge)
                else:  # and the epoch itself
                    epoch, now, u, low = k, time_ns[k], 0.0, here
                    if not seen[k]:
                        continue
                    edge[:] = p[k]
                if low >= max(best, clearance + wide):
                    continue
                if going and event_low <= low < clearance and low - wide >= event_bound:
                    span[1] = now  # it goes on, and is no graver for this instant
                    continue
                low = nearest(edge, segments, at)
                measured(edge, low, at, epoch, u, cov, common, segments, variance, table, row)
                if low < best:
                    best = low
                    rows[0] = row
                    times[0] = now
                if row[COLUMNS - 1] >= clearance:
                    continue
                if not going:
                    going, span[0], event_bound = True, now, np.inf
                span[1] = now
                event_bound = min(event_bound, row[COLUMNS - 1])
                if low < event_low:
                    event_low, span[2] = low, now
                    event[:] = row
                event[COLUMNS - 1] = event_bound
        if not blind and (not swept[k - 1] if k > 0 else not seen[0]):
            blind, blind_from, blind_near = True, time_ns[max(k - 1, 0)], before < reach
        if blind:
            blind_near = blind_near or here < reach or passed
            if seen[k] or k == n - 1:
                blind = False
                if blind_near:
                    length = time_ns[k] - blind_from
                    unseen[0] += 1
                    unseen[1] += length
                    if length > unseen[2]:
                        unseen[2], unseen[3] = length, blind_from
        before = here
    return times[: 1 + number], rows[: 1 + number], counts, unseen


@njit(cache=True, nogil=True)
def _keep(span, event, times, rows, counts, number):  # pragma: no cover - compiled
    """Count an approach and keep it, if it is among the lowest bounds; how many are kept now."""
    low, bound = event[COLUMNS - 5], event[COLUMNS - 1]
    counts[0 if low <= 0.0 else 1 if bound <= 0.0 else 2] += 1
    if number < len(times) - 1:
        number += 1
        slot = number
    else:
        slot = 1
        for other in range(2, len(rows)):
            if rows[other, COLUMNS - 1] > rows[slot, COLUMNS - 1]:
                slot = other
        if bound >= rows[slot, COLUMNS - 1]:
            return number
    times[slot] = span
    rows[slot] = event
    return number
