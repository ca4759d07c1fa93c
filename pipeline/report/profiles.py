"""Figures along and across the trench: long section, cross sections, check shots."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.report import palette
from pipeline.report.drawing import WIDTH_IN, decimated, new_figure
from pipeline.report.inputs import ReportInputs, Table
from pipeline.report.measured import Grid, Section, counted
from pipeline.report.units import Units, text_of
from pipeline.surface.design import Design

SIGMAS = 2.0
"""Half width of every ribbon and bar."""


def with_gaps(station: np.ndarray, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """The columns with a NaN wherever stations are missing from their regular row, so that lines break there."""
    if len(station) < 3:
        return station, *columns
    step = np.diff(station)
    holes = np.flatnonzero(step > 1.5 * np.median(step)) + 1
    middle = (station[holes - 1] + station[np.minimum(holes, len(station) - 1)]) / 2
    return np.insert(station, holes, middle), *(
        np.insert(np.asarray(c, float), holes, np.nan) for c in columns
    )


def long_section(inputs: ReportInputs, stations: Table, grid: Grid | None, units: Units) -> Figure:
    """Elevation, deviation and verdict by station, one above the other."""
    figure = new_figure(6.0)
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[2.0, 2.4, 0.9])
    s, h, design, deviation, own, common = with_gaps(
        *(
            np.asarray(stations[k], float)
            for k in ("station", "h", "design_h", "deviation", "sigma_own", "sigma_common")
        )
    )
    x = units.to_length(s)
    half = SIGMAS * np.hypot(own, common)
    high, low = inputs.site.tolerance.high_mm / 1000, inputs.site.tolerance.low_mm / 1000
    _elevations(axes[0], x, h, design, half, (low, high), units)
    _deviations(axes[1], x, deviation, half, (low, high), grid, units)
    checks = inputs.table("checks")
    if checks is not None:
        _shots(axes[0], axes[1], checks, stations, inputs.design, units)
    _verdicts(axes[2], stations, units)
    axes[2].set_xlabel(f"Station [{units.length}]")
    axes[2].set_xlim(*_span_shown(x, deviation))
    for ax in axes[:2]:
        # Beside the axes, never on a line: the station axis is the dear one here, so above.
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, borderaxespad=0.2, handlelength=1.6)
    figure.align_ylabels(axes)
    return figure


def _span_shown(x: np.ndarray, deviation: np.ndarray) -> tuple[float, float]:
    """The dug stations and a fifth of their length around, never beyond the design."""
    low, high = float(np.nanmin(x)), float(np.nanmax(x))
    edge = 0.02 * (high - low or 1.0)
    dug = x[np.isfinite(deviation)]
    if len(dug) == 0:
        return low - edge, high + edge
    around = 0.2 * max(float(np.ptp(dug)), 4 * edge)
    return max(low - edge, dug.min() - around), min(high + edge, dug.max() + around)


def _elevations(ax: Axes, x, h, design, half, tolerance: tuple[float, float], units: Units) -> None:
    low, high = tolerance
    ax.fill_between(
        x,
        units.to_length(design - low),
        units.to_length(design + high),
        color=palette.BAND,
        lw=0,
        label="tolerance",
    )
    ax.plot(x, units.to_length(design), color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)), label="design")
    ax.fill_between(x, units.to_length(h - half), units.to_length(h + half), color=palette.RIBBON, lw=0)
    ax.plot(x, units.to_length(h), color=palette.AS_BUILT, label="as-built")
    first, last = _span_shown(x, h)
    view = (x >= first) & (x <= last)
    known = np.concatenate([design[view] - low, design[view] + high, (h - half)[view], (h + half)[view]])
    bottom, top = units.to_length([np.nanmin(known), np.nanmax(known)])
    ax.set_ylim(bottom - 0.1 * (top - bottom), top + 0.1 * (top - bottom))
    ax.set_ylabel(f"Elevation [{units.length}]")
    ax.set_title("Elevation")


def _deviations(
    ax: Axes, x, deviation, half, tolerance: tuple[float, float], grid: Grid | None, units: Units
):
    low, high = (float(units.to_deviation(t)) for t in tolerance)
    ax.axhspan(-low, high, color=palette.BAND, lw=0)
    ax.axhline(0, color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)))
    if grid is not None:
        fine = _centre_line(grid)
        ax.plot(
            *decimated(units.to_length(fine[0]), units.to_deviation(fine[1])),
            color=palette.MUTED,
            lw=0.5,
            label="centre cells",
        )
    ax.fill_between(
        x,
        units.to_deviation(deviation - half),
        units.to_deviation(deviation + half),
        color=palette.RIBBON,
        alpha=0.8,
        lw=0,
        label="± 2 sigma",
    )
    ax.plot(x, units.to_deviation(deviation), color=palette.AS_BUILT, label="station mean")
    # A lone station between two gaps has no line to be seen by.
    alone = np.isfinite(deviation) & ~np.isfinite(np.r_[np.nan, deviation[:-1]])
    alone &= ~np.isfinite(np.r_[deviation[1:], np.nan])
    ax.plot(x[alone], units.to_deviation(deviation[alone]), "o", ms=2.5, color=palette.AS_BUILT)
    digits = units.deviation_digits
    for value in (high, -low):
        ax.annotate(
            text_of(value, digits, signed=True),
            (1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(2, 0),
            textcoords="offset points",
            va="center",
            fontsize=6.5,
            color=palette.MUTED,
            annotation_clip=False,
        )
    reach = (
        np.nanmax(np.abs(np.r_[deviation + half, deviation - half])) if np.isfinite(deviation).any() else 0
    )
    reach = max(float(units.to_deviation(reach)), 1.15 * high, 1.15 * low)
    ax.set_ylim(-1.08 * reach, 1.08 * reach)
    ax.set_ylabel(f"Deviation [{units.deviation}]")
    ax.set_title("Deviation (+ high, − low)")


def _centre_line(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    row = int(np.argmin(np.abs(grid.offset)))
    return grid.station, grid.values["deviation"][row]


def _shots(
    above: Axes, below: Axes, checks: Table, stations: Table, design: Design | None, units: Units
) -> None:
    """Check shots: their elevation above, and below where the shot lies against the design at its station."""
    on = np.isfinite(checks["station"]) & (np.asarray(checks["kind"]) == "floor")
    if design is not None:
        on &= design.is_floor(checks["station"], checks["offset"])
    station, h = np.asarray(checks["station"], float)[on], np.asarray(checks["h"], float)[on]
    sigma = np.asarray(checks["sigma_ts"], float)[on]
    marks: dict[str, Any] = {
        "fmt": "D",
        "ms": 3.2,
        "mfc": "white",
        "mec": palette.CHECK,
        "ecolor": palette.CHECK,
        "mew": 0.9,
    }
    above.errorbar(
        units.to_length(station),
        units.to_length(h),
        SIGMAS * units.to_length(sigma),
        elinewidth=0.8,
        label="check shots",
        **marks,
    )
    compared = np.asarray(checks["result"])[on] == "compared"
    if design is not None:
        level = design.elevation(station, np.asarray(checks["offset"], float)[on])
    else:
        level = np.interp(station, stations["station"], stations["design_h"], left=np.nan, right=np.nan)
    below.errorbar(
        units.to_length(station[compared]),
        units.to_deviation((h - level)[compared]),
        SIGMAS * units.to_deviation(sigma[compared]),
        elinewidth=0.8,
        label="check shots",
        **marks,
    )


def _verdicts(ax: Axes, stations: Table, units: Units) -> None:
    """One row of marks per verdict, so that no verdict is told by colour alone."""
    names = list(palette.VERDICTS)
    found = np.asarray(stations["verdict"], str)
    for row, name in enumerate(names):
        style = palette.VERDICTS[name]
        at = units.to_length(np.asarray(stations["station"], float)[found == name])
        ax.plot(
            at,
            np.full(len(at), row),
            style.marker,
            color=style.ink,
            ms=4,
            mew=1.4 if style.marker == "_" else 0,
        )
    ax.set_yticks(range(len(names)), [f"{palette.VERDICTS[n].symbol} {n}" for n in names])
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_title("Verdict")


def cross_sections(inputs: ReportInputs, sections: list[Section], units: Units) -> Figure:
    """Small multiples, all with the same scales: elevation by offset."""
    columns = min(3, len(sections))
    rows = -(-len(sections) // columns)
    figure = new_figure(0.35 + 1.65 * rows, WIDTH_IN)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
    low, high = inputs.site.tolerance.low_mm / 1000, inputs.site.tolerance.high_mm / 1000
    reach = [_limits(section, low, high) for section in sections]
    height = max(top - bottom for bottom, top in reach)
    for ax, section, (bottom, top) in zip(axes.flat, sections, reach):
        x, half = units.to_length(section.offset), SIGMAS * section.sigma
        d, h = section.design_h, section.h
        floor = np.where(section.floor, d, np.nan)
        ax.fill_between(
            x,
            units.to_length(floor - low),
            units.to_length(floor + high),
            color=palette.BAND,
            lw=0,
            label="tolerance",
        )
        ax.plot(x, units.to_length(d), color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)), label="design")
        ax.fill_between(
            x,
            units.to_length(h - half),
            units.to_length(h + half),
            color=palette.RIBBON,
            lw=0,
            label="± 2 sigma",
        )
        ax.plot(x, units.to_length(h), color=palette.AS_BUILT, label="as-built")
        middle = (bottom + top) / 2
        ax.set_ylim(*units.to_length([middle - 0.55 * height, middle + 0.55 * height]))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_locator(MaxNLocator(5))
        mark = "  (one of the worst)" if section.why == "worst" else ""
        ax.set_title(
            f"{text_of(float(units.to_length(section.station)), units.station_digits)} {units.length}{mark}"
        )
    for ax in axes.flat[len(sections) :]:
        ax.remove()
    for at in range(columns):
        lowest = max(i for i in range(len(sections)) if i % columns == at)
        axes.flat[lowest].set_xlabel(f"Offset [{units.length}]")
        axes.flat[lowest].tick_params(labelbottom=True)
    for row in axes:
        row[0].set_ylabel(f"Elevation [{units.length}]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=4, handlelength=1.6)
    return figure


def _limits(section: Section, low: float, high: float) -> tuple[float, float]:
    on = section.floor
    d, h, half = section.design_h[on], section.h[on], SIGMAS * section.sigma[on]
    known = np.concatenate([d - low, d + high, h - half, h + half])
    return float(np.nanmin(known)), float(np.nanmax(known))


def sides(inputs: ReportInputs, table: Table, units: Units) -> Figure:
    """How far each side of the floor lies outside its design, by station, with two standard deviations."""
    figure = new_figure(2.4)
    ax = figure.subplots()
    side = np.asarray(table["side"], str)
    tolerance = inputs.site.tolerance
    if tolerance.wide_mm is not None and tolerance.narrow_mm is not None:
        low, high = units.to_deviation([-tolerance.narrow_mm / 1000, tolerance.wide_mm / 1000])
        ax.axhspan(low, high, color=palette.BAND, lw=0, label="tolerance")
    ax.axhline(0, color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)))
    reach = np.isfinite(table["outward"])
    stations = np.asarray(table["station"], float)
    for name, colour, marker in (("left", palette.ACCENTS[0], "o"), ("right", palette.ACCENTS[1], "s")):
        at = side == name
        x = units.to_length(stations[at])
        y = units.to_deviation(np.asarray(table["outward"], float)[at])
        half = SIGMAS * units.to_deviation(np.hypot(table["sigma_own"], table["sigma_common"])[at])
        ax.fill_between(x, y - half, y + half, color=colour, alpha=0.18, lw=0)
        ax.plot(x, y, color=colour, marker=marker, ms=3, lw=1.0, label=f"{name} side")
    if reach.any():
        first, last = units.to_length([stations[reach].min(), stations[reach].max()])
        margin = 0.03 * max(last - first, 1.0)
        ax.set_xlim(first - margin, last + margin)
    ax.set_xlabel(f"Station [{units.length}]")
    ax.set_ylabel(f"− narrow   outward [{units.deviation}]   + wide")
    figure.legend(loc="outside upper right", ncols=3, handlelength=1.6)
    return figure


def check_shots(checks: Table, units: Units) -> Figure:
    """Difference of each compared shot with two combined sigmas, by station."""
    compared = counted(checks)
    x = units.to_length(np.asarray(checks["station"], float)[compared])
    y = units.to_deviation(np.asarray(checks["difference"], float)[compared])
    bar = SIGMAS * units.to_deviation(np.hypot(checks["sigma"], checks["sigma_ts"])[compared])
    figure = new_figure(2.4)
    ax = figure.subplots()
    ax.axhline(0, color=palette.DESIGN, lw=0.9, ls=(0, (5, 2)))
    ax.errorbar(
        x,
        y,
        bar,
        fmt="D",
        ms=3.2,
        mfc="white",
        mec=palette.CHECK,
        ecolor=palette.CHECK,
        elinewidth=0.8,
        mew=0.9,
        capsize=1.5,
    )
    reach = 1.15 * float(np.max(np.abs(y) + bar))
    ax.set_ylim(-reach, reach)
    ax.set_ylabel(f"Difference [{units.deviation}]")
    ax.set_xlabel(f"Station [{units.length}]")
    if len(x) <= 25:
        names = [_short(str(p)) for p in np.asarray(checks["point"])[compared]]
        for name, at, top in zip(names, x, y + bar):
            ax.annotate(
                name,
                (at, top),
                (0, 2),
                textcoords="offset points",
                ha="center",
                fontsize=6,
                color=palette.MUTED,
            )
    return figure


def _short(name: str) -> str:
    return name if len(name) <= 8 else name[:7] + "…"
