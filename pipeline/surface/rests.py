"""When the cutting edge stood still, where, and how sure that is: for what a surveyor measured of the parked machine.

The rule, printed in docs/machine-and-site.md: every epoch of a rest was seen, no two follow each other by more than
`max_step_s`, it lasts at least `still_s`, and left, middle and right stay within `still_m` and three own standard
deviations of where they were at its beginning. A boom that sinks slowly gives one rest after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.tracks.poses import CuttingEdge

TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class RestRule:
    """What counts as standing still."""

    still_s: float = 2.0
    """A total station takes a second or two for one measurement."""
    still_m: float = 0.010
    """More than the path of a still edge wanders within its noise, less than a bucket that settles."""
    max_step_s: float = 0.5
    mean_over_s: float = 4.0
    """Of a long rest so much about the wanted time is averaged: hydraulics sink over minutes."""


@dataclass(frozen=True)
class Rests:
    """Stretches in which the edge stood still."""

    first: np.ndarray
    """(k,) first epoch."""
    stop: np.ndarray
    """(k,) the epoch after the last."""

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True)
class Stand:
    """The edge as it stood about one time."""

    time_ns: int
    points: np.ndarray
    """(3, 3): left, middle, right; easting, northing, elevation, grid metres."""
    own: np.ndarray
    """(3, 3, 3) own covariance of each point's mean, m²."""
    common: np.ndarray
    """(3, 3, 3) common covariance."""


def rests_of(edge: CuttingEdge, rule: RestRule | None = None) -> Rests:
    """Every rest of the log, in the order of time; see the rule above."""
    rule = rule or RestRule()
    n = len(edge)
    first: list[int] = []
    stop: list[int] = []
    if n < 2:
        return Rests(np.zeros(0, np.int64), np.zeros(0, np.int64))
    still_ns = round(rule.still_s * 1e9)
    broken = ~edge.seen[1:] | ~edge.seen[:-1] | (np.diff(edge.time_ns) > round(rule.max_step_s * 1e9))
    # Epoch at which the unbroken stretch of each epoch ends (the last one in it).
    ends = np.append(np.flatnonzero(broken), n - 1)
    last = ends[np.searchsorted(ends, np.arange(n))]
    own = edge.cov[:, :, (0, 3, 5)] - edge.common[:, :, (0, 3, 5)]
    bound = rule.still_m + 3.0 * np.sqrt(np.maximum(own.max(axis=(1, 2)), 0.0))
    # Where it is far off after half of the time or all of it nothing needs to be looked at closely.
    maybe = edge.seen.copy()
    for share in (0.5, 1.0):
        later = np.searchsorted(edge.time_ns, edge.time_ns + round(share * still_ns))
        inside = later <= last
        later = np.minimum(later, n - 1)
        maybe &= inside & (_away(edge.p_grid, edge.p_grid[later]) <= np.maximum(bound, bound[later]))
    k = 0
    for i in np.flatnonzero(maybe).tolist():
        if i < k:
            continue
        j = int(np.searchsorted(edge.time_ns, edge.time_ns[i] + still_ns, side="left"))
        end = i
        while end < last[i]:  # in portions: a machine may be parked for hours
            here = slice(end + 1, min(end + 4097, int(last[i]) + 1))
            limit = np.maximum(bound[here], bound[i])
            gone = np.flatnonzero(_away(edge.p_grid[here], edge.p_grid[i]) > limit)
            if len(gone):
                end = end + int(gone[0])
                break
            end = here.stop - 1
        if end >= j:
            first.append(i)
            stop.append(end + 1)
            k = end + 1
    return Rests(np.array(first, np.int64), np.array(stop, np.int64))


def stand_at(
    edge: CuttingEdge,
    rests: Rests,
    which: int,
    time_ns: int,
    correlation_s: float | None,
    rule: RestRule | None = None,
) -> Stand:
    """The mean of the edge about a time of a rest, with its covariances.

    Errors of epochs that follow each other are nearly one error: with the correlation time tau the own part of a mean
    over T is ``2 tau / T (1 - tau / T (1 - exp(-T / tau)))`` of that of an epoch; without one it is not reduced.
    """
    rule = rule or RestRule()
    epochs = np.arange(rests.first[which], rests.stop[which])
    stamps = edge.time_ns[epochs]
    half = round(0.5 * rule.mean_over_s * 1e9)
    centre = min(max(time_ns, int(stamps[0]) + half), max(int(stamps[-1]) - half, int(stamps[0])))
    epochs = epochs[(stamps >= centre - half) & (stamps <= centre + half)]
    span_s = (edge.time_ns[epochs[-1]] - edge.time_ns[epochs[0]]) * 1e-9
    common = _square(edge.common[epochs].mean(axis=0))
    own = _square((edge.cov[epochs] - edge.common[epochs]).mean(axis=0)) * share_left(span_s, correlation_s)
    middle = int(epochs[len(epochs) // 2])
    return Stand(int(edge.time_ns[middle]), edge.p_grid[epochs].mean(axis=0), own, common)


def nearest_rest(edge: CuttingEdge, rests: Rests, time_ns: int) -> tuple[int, int]:
    """The rest that is nearest in time, and how far away it is, ns: 0 within it. -1 where there is none."""
    if not len(rests):
        return -1, 0
    away = np.maximum(edge.time_ns[rests.first] - time_ns, time_ns - edge.time_ns[rests.stop - 1])
    away = np.maximum(away, 0)
    k = int(np.argmin(away))
    return k, int(away[k])


def point_on(stand: Stand, name: str, p_grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left, middle or right, or the place on the edge's line nearest to a point; with own and common covariance."""
    if name:
        i = ("left", "middle", "right").index(name)
        return stand.points[i], stand.own[i], stand.common[i]
    along = stand.points[2] - stand.points[0]
    share = float(np.clip((p_grid - stand.points[0]) @ along / max(float(along @ along), 1e-12), 0.0, 1.0))
    weight = np.maximum(1.0 - np.abs(2.0 * share - np.arange(3)), 0.0)
    place = (1.0 - share) * stand.points[0] + share * stand.points[2]
    return place, np.tensordot(weight, stand.own, axes=1), np.tensordot(weight, stand.common, axes=1)


def _away(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(n,) how far the farthest of the three points is from where it was."""
    return np.sqrt(((p - q) ** 2).sum(axis=-1)).max(axis=-1)


def share_left(span_s: float, tau_s: float | None) -> float:
    """Share of the own variance of one epoch that a mean over a span keeps; see `stand_at`."""
    if tau_s is None or tau_s <= 0 or span_s <= 0:
        return 1.0
    x = span_s / tau_s
    return float(2.0 / x * (1.0 - (1.0 - np.exp(-x)) / x))


def _square(triangle: np.ndarray) -> np.ndarray:
    """(..., 3, 3) of (..., 6) upper triangles."""
    out = np.empty((*triangle.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(TRIANGLE):
        out[..., i, j] = out[..., j, i] = triangle[..., k]
    return out
