"""When the machine stood still: spans in which no point of the cutting edge moved more than its own noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

BIN_S = 1.0
"""A digging cycle has no still second; a mean over one averages most of the noise of its epochs away."""
STILL_M = 0.015
"""From the place at the span's beginning. Three times the sigma of an epoch, ten times that of a second's mean."""
SHORTEST_S = 5.0
"""Waiting for a lorry, not the pause between two strokes."""
POINTS = ("left", "middle", "right")


def idle_spans(edge: Mapping[str, np.ndarray], start_ns: int) -> np.ndarray:
    """Spans in which all three points of the observed cutting edge stayed where they were.

    Parameters
    ----------
    edge : table
        The cutting edge: time_ns, point, e, n, h, seen.
    start_ns : int
        From where the seconds are counted.

    Returns
    -------
    (s, 2) int array
        Nanoseconds, from whole second to whole second: what was not observed is not known to be idle.
    """
    seen = np.asarray(edge["seen"], bool)
    second = (np.asarray(edge["time_ns"], np.int64) - start_ns) // int(BIN_S * 1e9)
    inside = seen & (second >= 0)
    if not inside.any():
        return np.zeros((0, 2), np.int64)
    bins = int(second[inside].max()) + 1
    mean = np.full((bins, len(POINTS), 3), np.nan)
    spread = np.zeros((bins, len(POINTS)))
    for i, name in enumerate(POINTS):
        own = inside & (edge["point"] == name)
        at, count = second[own], np.bincount(second[own], minlength=bins)
        for k, axis in enumerate("enh"):
            # From the first value on: squares of seven-digit northings would leave no millimetres.
            values = np.asarray(edge[axis][own], float)
            values = values - (values[0] if len(values) else 0.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                mean[:, i, k] = np.bincount(at, values, bins) / count
                spread[:, i] += np.bincount(at, values**2, bins) / count - mean[:, i, k] ** 2
    with np.errstate(invalid="ignore"):
        # NaN, a second without one of the points, compares as not still.
        quiet = (np.sqrt(np.maximum(spread, 0.0)) <= STILL_M).all(axis=1) & np.isfinite(mean).all(axis=(1, 2))
    return start_ns + int(BIN_S * 1e9) * _runs(mean, quiet)


def _runs(mean: np.ndarray, quiet: np.ndarray) -> np.ndarray:
    """(s, 2) first bin and the one after the last of each run that stays within STILL_M of where it began."""
    least = int(np.ceil(SHORTEST_S / BIN_S))
    found, at = [], 0
    while at < len(quiet):
        end = at
        while (
            end < len(quiet) and quiet[end] and np.linalg.norm(mean[end] - mean[at], axis=1).max() <= STILL_M
        ):
            end += 1
        if end - at >= least:
            found.append((at, end))
        at = end if end - at >= least else at + 1
    return np.array(found, np.int64).reshape(-1, 2)
