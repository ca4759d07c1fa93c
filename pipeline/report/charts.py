"""Figures of the evidence: error budget, coverage over time, pixel noise, residuals."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pipeline.report import numbers, palette
from pipeline.report.drawing import new_figure
from pipeline.report.evidence import HISTOGRAM_EDGES, Timeline
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
    """Accepted tags per frame over time, one strip per camera, gaps in grey behind all of them."""
    count = max(1, len(timeline.frames))
    figure = new_figure(0.6 + 1.05 * count)
    axes = np.atleast_1d(figure.subplots(count, 1, sharex=True))
    length = timeline.edges_s[-1]
    scale, unit = (1.0, "s") if length < 300 else (60.0, "min") if length < 10_800 else (3600.0, "h")
    for ax, (camera, frames) in zip(axes, timeline.frames.items()):
        tags = timeline.accepted[camera] / np.maximum(frames, 1)
        for start, end in (timeline.gaps_ns - timeline.start_ns) / 1e9:
            ax.axvspan(start / scale, end / scale, color=palette.PASSED_OVER, lw=0)
        ax.stairs(tags, timeline.edges_s / scale, color=palette.AS_BUILT, fill=True, alpha=0.35)
        ax.stairs(tags, timeline.edges_s / scale, color=palette.AS_BUILT, lw=0.9)
        ax.set_title(f"Camera {camera}")
        ax.set_ylabel("tags per frame")
        ax.set_ylim(0, max(1.1 * float(tags.max(initial=0)), 1.0))
        ax.set_xlim(0, length / scale)
    axes[-1].set_xlabel(
        f"Time from {numbers.utc_text(timeline.start_ns)} [{unit}]; grey: cutting edge not observed, bridged"
    )
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
