"""Two histograms: how the check shots scatter against their sigmas, and how far the cells are from the design."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.report import numbers
from pipeline.report.inputs import ReportInputs
from pipeline.report.measured import Grid
from pipeline.report.numbers import column
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words
from pipeline.surface.checks import COMPARED

Z_REACH = 4.0
FINE_FROM = 100
"""Shots from which bins are half a sigma wide; of fewer, each bin would hold one or two."""
MOST_BINS = 40
BEYOND_SHARE = 0.002
"""At most this share of the cells, half on each side, lies in the outermost bins besides their own."""


@dataclass(frozen=True)
class Histogram:
    """Counts by bin; the first and the last hold all beyond."""

    edges: np.ndarray
    """(n + 1,) in the printed unit."""
    count: np.ndarray
    """(n,) int."""
    expected: np.ndarray | None = None
    """(n,) what the stated sigmas would give."""


def check_residuals(inputs: ReportInputs) -> Histogram | None:
    """Normalised differences of the compared shots with what a standard normal would give; None without any."""
    checks = inputs.table("checks")
    if checks is None:
        return None
    z = np.asarray(checks["z"], float)
    z = z[np.isfinite(z) & (np.asarray(checks["result"]) == COMPARED)]
    if not len(z):
        return None
    edges = np.arange(-Z_REACH, Z_REACH + 1e-9, 0.5 if len(z) >= FINE_FROM else 1.0)
    below = np.array([0.5 * (1 + math.erf(edge / math.sqrt(2))) for edge in edges])
    below[0], below[-1] = 0.0, 1.0
    return Histogram(edges, _counted(z, edges), len(z) * np.diff(below))


def cell_deviations(inputs: ReportInputs, grid: Grid, units: Units) -> Histogram | None:
    """Deviations of the cut cells of the floor in round bins of the deviation unit; None without any."""
    deviation = grid.values["deviation"][grid.values["floor"]]
    deviation = units.to_deviation(deviation[np.isfinite(deviation)])
    if not len(deviation):
        return None
    tolerance = inputs.site.tolerance
    limits = units.to_deviation(np.array([-tolerance.low_mm, tolerance.high_mm]) / 1000)
    low, high = np.quantile(deviation, [BEYOND_SHARE / 2, 1 - BEYOND_SHARE / 2])
    low, high = min(float(low), float(limits[0])), max(float(high), float(limits[1]))
    step = _round_step((high - low) / MOST_BINS)
    first = math.floor(low / step - 1e-9)
    last = max(math.ceil(high / step + 1e-9), first + 1)
    edges = np.array([step * i for i in range(first, last + 1)])
    return Histogram(edges, _counted(deviation, edges))


def _round_step(least: float) -> float:
    """The smallest of 1, 2, 5, 10, ... and their tenths that is not under `least`."""
    power = 10.0 ** math.floor(math.log10(max(least, 1e-9)))
    return next(power * step for step in (1.0, 2.0, 5.0, 10.0) if power * step >= least * (1 - 1e-9))


def _counted(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    inside = np.clip(values, edges[0], np.nextafter(edges[-1], -np.inf))
    return np.histogram(inside, edges)[0]


def check_residuals_table(found: Histogram, words: Words) -> dict[str, Any]:
    """Bins of the normalised differences: observed and expected shots."""
    columns = [
        column("bin", words("columns.z")),
        column("count", words("columns.shots"), "", 0),
        column("expected", words("columns.expected"), "", 1),
    ]
    names = _names(found.edges, 1, words)
    assert found.expected is not None
    rows = numbers.records({"bin": names, "count": found.count, "expected": found.expected})
    return numbers.table(columns, rows)


def cell_deviations_table(found: Histogram, units: Units, words: Words) -> dict[str, Any]:
    """Bins of the deviations: cells and their share."""
    columns = [
        column("bin", f"{words('columns.deviation')} [{units.deviation}]"),
        column("count", words("columns.cells"), "", 0),
        column("share", words("columns.share_cells"), "%", 1),
    ]
    step = found.edges[1] - found.edges[0]
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    share = 100.0 * found.count / found.count.sum()
    names = _names(found.edges, digits, words)
    return numbers.table(columns, numbers.records({"bin": names, "count": found.count, "share": share}))


def _names(edges: np.ndarray, digits: int, words: Words) -> list[str]:
    """Bins in words; the outermost say that they hold all beyond."""
    texts = [text_of(edge, digits, signed=True) for edge in edges.tolist()]
    last = len(edges) - 2
    return [
        words("histogram.below", high=high)
        if i == 0
        else words("histogram.above", low=low)
        if i == last
        else words("histogram.between", low=low, high=high)
        for i, (low, high) in enumerate(pairwise(texts))
    ]
