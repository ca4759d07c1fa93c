"""Figures of the evidence: error budget, uncertainty, coverage over time, pixel noise, histograms."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from pipeline.report import numbers, palette
from pipeline.report.drawing import decimated, new_figure
from pipeline.report.evidence import HISTOGRAM_EDGES, Timeline
from pipeline.report.histograms import Histogram
from pipeline.report.inputs import Table
from pipeline.report.profiles import with_gaps
from pipeline.report.units import Units, text_of

CAMERA_MARKERS = ("o", "s", "^", "D", "v")


def error_budget(parts: list[tuple[str, float]], units: Units) -> Figure:
    """Bars of the standard deviation by source, the longest on top."""
    figure = new_figure(0.65 + 0.28 * len(parts))
    ax = figure.subplots()
    names = [name for name, _ in parts]
    sigma = units.to_deviation([value for _, value in parts])
    ax.barh(range(len(parts)), sigma, color=palette.AS_BUILT, height=0.62)
    for row, value in enumerate(sigma):
        text = f"{text_of(value, units.fine_digits)} {units.deviation}"
        ax.annotate(text, (value, row), (4, 0), textcoords="offset points", va="center", fontsize=7)
    ax.set_yticks(range(len(parts)), names)
    ax.set_ylim(len(parts) - 0.4, -0.6)
    ax.set_xlim(0, 1.15 * max(float(sigma.max()), 1e-9))
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"Standard deviation in elevation [{units.deviation}]")
    return figure


def coverage(timeline: Timeline) -> Figure:
    """Accepted tags per frame over time, one strip per camera, and below them when the edge was bridged or still."""
    count = max(1, len(timeline.frames))
    figure = new_figure(1.05 + 1.05 * count)
    axes = np.atleast_1d(figure.subplots(count + 1, 1, sharex=True, height_ratios=[1.0] * count + [0.42]))
    length = timeline.edges_s[-1]
    scale, unit = (1.0, "s") if length < 300 else (60.0, "min") if length < 10_800 else (3600.0, "h")
    gaps, idle = ((spans - timeline.start_ns) / 1e9 / scale for spans in (timeline.gaps_ns, timeline.idle_ns))
    for ax, (camera, frames) in zip(axes, timeline.frames.items()):
        tags = timeline.accepted[camera] / np.maximum(frames, 1)
        for start, end in gaps:
            ax.axvspan(start, end, color=palette.PASSED_OVER, lw=0)
        ax.stairs(tags, timeline.edges_s / scale, color=palette.AS_BUILT, fill=True, alpha=0.35)
        ax.stairs(tags, timeline.edges_s / scale, color=palette.AS_BUILT, lw=0.9)
        ax.set_title(f"Camera {camera}")
        ax.set_ylabel("tags per frame")
        ax.set_ylim(0, max(1.1 * float(tags.max(initial=0)), 1.0))
        ax.set_xlim(0, length / scale)
    strip = axes[-1]
    # Bars in rows with a name each, so that neither is told by its colour.
    rows = ((gaps, palette.MUTED, ""), (idle, palette.RIBBON, "////"))
    for row, (spans, colour, hatch) in enumerate(rows):
        bars = [(float(start), float(end - start)) for start, end in spans]
        strip.broken_barh(bars, (row - 0.36, 0.72), fc=colour, ec=palette.INK, lw=0.4, hatch=hatch)
    strip.set_yticks((0, 1), ("bridged", "still"))
    strip.set_ylim(1.6, -0.6)
    strip.tick_params(axis="y", length=0)
    strip.grid(axis="y", visible=False)
    strip.set_title("Cutting edge")
    strip.set_xlabel(f"Time from {numbers.utc_text(timeline.start_ns)} [{unit}]; grey above: bridged")
    figure.align_ylabels(axes)
    return figure


def uncertainty(stations: Table, limit_m: float, units: Units) -> Figure:
    """Sigma of each station, its own and its common part, with the sigma beyond which no deviation could pass."""
    figure = new_figure(2.4)
    ax = figure.subplots()
    station, own, common = with_gaps(
        *(np.asarray(stations[name], float) for name in ("station", "sigma_own", "sigma_common"))
    )
    lines = (
        ("both together", np.hypot(own, common), palette.INK, "-", 1.4),
        ("own part: more passes help", own, palette.ACCENTS[0], (0, (5, 2)), 1.2),
        ("common part: calibration and survey help", common, palette.ACCENTS[1], (0, (1.5, 1.2)), 1.2),
    )
    top = 0.0
    for label, sigma, colour, style, width in lines:
        x, y = decimated(units.to_length(station), units.to_deviation(sigma))
        ax.plot(x, y, color=colour, ls=style, lw=width, label=label)
        alone = np.isfinite(y) & ~np.isfinite(np.r_[np.nan, y[:-1]]) & ~np.isfinite(np.r_[y[1:], np.nan])
        ax.plot(x[alone], y[alone], "o", ms=2.5, color=colour)
        top = max(top, float(np.nanmax(y, initial=0.0)))
    limit = float(units.to_deviation(limit_m))
    if limit < 3 * top:  # far above, it would press the lines together and say nothing
        ax.axhline(limit, color=palette.MUTED, lw=0.9, ls=(0, (8, 2, 2, 2)), label="not capable beyond")
        top = max(top, limit)
    ax.set_ylim(0, 1.12 * max(top, 1e-9))
    ax.set_xlabel(f"Station [{units.length}]")
    ax.set_ylabel(f"Sigma in elevation [{units.deviation}]")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2, handlelength=2.4)
    return figure


def check_residuals(found: Histogram) -> Figure:
    """Bars of the normalised differences of the check shots with what honest sigmas would give."""
    figure = new_figure(2.1)
    ax = figure.subplots()
    middle = (found.edges[:-1] + found.edges[1:]) / 2
    wide = found.edges[1] - found.edges[0]
    label = "observed"
    ax.bar(middle, found.count, 0.9 * wide, color=palette.RIBBON, ec=palette.AS_BUILT, lw=0.5, label=label)
    expected = np.zeros(len(middle)) if found.expected is None else found.expected
    ax.plot(middle, expected, color=palette.DESIGN, lw=1.0, marker="o", ms=2.4, label="expected")
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.set_xlim(found.edges[0], found.edges[-1])
    ax.set_xlabel("Normalised difference z; the outermost bars hold all beyond")
    ax.set_ylabel("Check shots")
    ax.legend(loc="upper right")
    return figure


def cell_deviations(found: Histogram, limits: tuple[float, float], units: Units) -> Figure:
    """Bars of the cells' deviations with the limits of the tolerance, both in the deviation unit."""
    figure = new_figure(2.3)
    ax = figure.subplots()
    share = 100.0 * found.count / found.count.sum()
    ax.axvspan(*limits, color=palette.BAND, lw=0, zorder=0, label="tolerance")
    ax.bar(
        found.edges[:-1],
        share,
        np.diff(found.edges),
        align="edge",
        color=palette.RIBBON,
        ec=palette.AS_BUILT,
        lw=0.5,
        label="cells",
    )
    ax.axvline(0, color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)), label="design")
    ax.set_xlim(found.edges[0], found.edges[-1])
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: text_of(v, units.deviation_digits, True)))
    ax.set_xlabel(f"Deviation [{units.deviation}], + high, − low; the outermost bars hold all beyond")
    ax.set_ylabel("Cells [%]")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.2)
    return figure


def pixel_noise(tags: dict[str, list[tuple[float, float, float]]]) -> Figure:
    """Scatter of each tag's corners over its side, with the prediction as a dash above or below (paper, Fig. 11)."""
    figure = new_figure(2.5)
    ax = figure.subplots()
    for number, (camera, points) in enumerate(tags.items()):
        side, scatter, predicted = np.array(points).T
        colour, marker = palette.ACCENTS[number % len(palette.ACCENTS)], CAMERA_MARKERS[number % 5]
        ax.vlines(side, scatter, predicted, color=palette.RULE, lw=0.8, zorder=1)
        label = "predicted" if number == 0 else None
        ax.plot(side, predicted, "_", color=palette.DESIGN, ms=7, mew=1.1, zorder=2, label=label)
        ax.plot(side, scatter, marker, color=colour, ms=4, zorder=3, label=f"observed, camera {camera}")
    ax.set_ylim(0, 1.15 * max(max(point[1:]) for points in tags.values() for point in points))
    ax.margins(x=0.08)
    ax.set_xlabel("Side of the tag [px]")
    ax.set_ylabel("Scatter of a corner, RMS [px]")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def residuals(observed: np.ndarray, expected: np.ndarray) -> Figure:
    """Histogram of whitened corner residuals with what the stated noise would give."""
    figure = new_figure(2.3)
    ax = figure.subplots()
    middle = (HISTOGRAM_EDGES[:-1] + HISTOGRAM_EDGES[1:]) / 2
    ax.bar(middle, observed, 0.23, color=palette.RIBBON, ec=palette.AS_BUILT, lw=0.5, label="observed")
    ax.plot(
        middle,
        expected,
        color=palette.DESIGN,
        lw=1.0,
        marker="o",
        ms=2.2,
        label="expected of the stated noise",
    )
    ax.set_xlim(0, HISTOGRAM_EDGES[-1])
    ax.set_xlabel("Length of the normalised residual of a corner; the last bar holds all beyond")
    ax.set_ylabel("Corners [%]")
    ax.legend(loc="upper right")
    return figure
