"""Figures seen from above: the plan, and the deviation map by station and offset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from pipeline.report import numbers, palette, utilities
from pipeline.report.drawing import DEVIATION_MAP, WIDTH_IN, new_figure
from pipeline.report.inputs import ReportInputs
from pipeline.report.measured import Grid
from pipeline.report.numbers import column
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words
from pipeline.surface.alignment import Alignment

MAX_PLAN_COLUMNS = 1500
MAX_MAP_COLUMNS = 1500
LABELS = (
    ((0, 5), "center", "bottom"),
    ((6, 0), "left", "center"),
    ((0, -6), "center", "top"),
    ((-6, 0), "right", "center"),
)
"""Where the names of neighbouring benchmarks go in turn, so that close ones do not cover each other."""


def drawn_line(line: Alignment) -> np.ndarray:
    """(n, 2) points of the alignment close enough together to draw its arcs, grid metres."""
    middle = np.linspace(line.start_station, line.end_station, 400)
    return line.points(np.unique(np.concatenate([middle, line.station])), 0.0)


def scale_of(inputs: ReportInputs, grid: Grid) -> float:
    """Largest deviation of the colour scale in metres: twice the wider tolerance, more where cells need it."""
    tolerance = 2 * max(inputs.site.tolerance.high_mm, inputs.site.tolerance.low_mm, 1.0) / 1000
    known = np.abs(grid.values["deviation"][np.isfinite(grid.values["deviation"]) & grid.values["floor"]])
    spread = float(np.quantile(known, 0.95)) if len(known) else 0.0
    return tolerance if spread <= tolerance else spread


def benchmarks_en(inputs: ReportInputs) -> dict[str, np.ndarray]:
    """Surveyed benchmark -> easting and northing, grid metres."""
    scale = inputs.site.grid.metres_per_unit
    found = {}
    for name, mark in inputs.site.benchmarks.items():
        if not mark.is_surveyed:
            continue
        enh = [mark.pose.enh] if mark.pose else [corner.enh for corner in mark.corners]
        found[name] = np.mean(np.array(enh, float), axis=0)[:2] * scale
    return found


def points_table(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any]:
    """Benchmarks and check shots of the plan with their coordinates."""
    columns = [
        column("point", words("columns.point"), kind="id"),
        column("what", words("columns.what")),
        column("e", words("columns.e"), units.length, units.length_digits),
        column("n", words("columns.n"), units.length, units.length_digits),
    ]
    rows = [
        {
            "point": name,
            "what": words("plan.benchmark"),
            "e": units.to_length(en[0]),
            "n": units.to_length(en[1]),
        }
        for name, en in benchmarks_en(inputs).items()
    ]
    if (checks := inputs.table("checks")) is not None:
        rows += [
            {"point": name, "what": words("plan.check"), "e": units.to_length(e), "n": units.to_length(n)}
            for name, e, n in zip(checks["point"], checks["e"], checks["n"])
        ]
    return numbers.table(columns, rows)


@dataclass(frozen=True)
class Sheet:
    """Where a grid coordinate lies on the plan: in the page's unit, from a round corner nearby.

    Seven-digit northings would be cut into steps by the renderer's 32 bit floats.
    """

    corner: np.ndarray
    """(2,) round easting and northing, length unit."""
    per_metre: float

    def place(self, en: np.ndarray) -> np.ndarray:
        """(..., 2) grid metres -> (..., 2) on the sheet."""
        return np.asarray(en, float) * self.per_metre - self.corner


def plan(inputs: ReportInputs, line: Alignment, grid: Grid, units: Units) -> Figure:
    """North up and to scale: alignment, design outline, cells by deviation, check shots, benchmarks."""
    marks = benchmarks_en(inputs)
    checks = inputs.table("checks")
    outline, centre = _outline(grid, line), drawn_line(line)
    corners = [_near(centre, line, grid), *outline, *(mark[None] for mark in marks.values())]
    if checks is not None:
        corners.append(np.stack([checks["e"], checks["n"]], axis=1))
    everything = np.concatenate(corners) * units.per_metre
    sheet = Sheet(np.floor(everything.min(axis=0) / 10) * 10, units.per_metre)
    low, high = everything.min(axis=0) - sheet.corner, everything.max(axis=0) - sheet.corner
    size = np.maximum(high - low, 1.0) + 0.14 * float(np.max(high - low))
    wide = 0.78 * WIDTH_IN
    height = float(np.clip(wide * size[1] / size[0], 2.0, 4.6))
    size = np.maximum(size, [size[1] * wide / height, size[0] * height / wide])  # fill the frame with ground
    figure = new_figure(height + 0.75)
    ax = figure.subplots()
    middle = (low + high) / 2
    ax.set_xlim(middle[0] - size[0] / 2, middle[0] + size[0] / 2)
    ax.set_ylim(middle[1] - size[1] / 2, middle[1] + size[1] / 2)
    reach = scale_of(inputs, grid)
    norm = Normalize(-float(units.to_deviation(reach)), float(units.to_deviation(reach)))
    _cells(ax, grid, line, sheet, norm, units)
    for ring in outline:
        ax.add_patch(Polygon(sheet.place(ring), fill=False, ec=palette.DESIGN, lw=0.6))
    dashes = (0, (8, 2, 2, 2))
    ax.plot(*sheet.place(centre).T, color=palette.DESIGN, lw=0.7, ls=dashes)
    _station_marks(ax, line, sheet, grid, units)
    if checks is not None:
        at = sheet.place(np.stack([checks["e"], checks["n"]], axis=1))
        ax.plot(*at.T, "D", ms=3.4, mfc="white", mec=palette.CHECK, mew=0.9, ls="", label="check shot")
    for i, (name, en) in enumerate(marks.items()):
        at = sheet.place(en)
        ax.plot(*at, "^", ms=6, color=palette.INK, ls="", label="benchmark" if i == 0 else None)
        (dx, dy), ha, va = LABELS[i % len(LABELS)]
        ax.annotate(name, tuple(at), (dx, dy), textcoords="offset points", ha=ha, va=va, fontsize=7)
    utilities.draw_on_plan(ax, inputs, sheet.place)
    for axis, start in ((ax.xaxis, sheet.corner[0]), (ax.yaxis, sheet.corner[1])):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], min_n_ticks=2))
        axis.set_major_formatter(FuncFormatter(lambda value, _, start=start: _coordinate(value + start)))
    ax.set_xlabel(f"Easting [{units.length}]")
    ax.set_ylabel(f"Northing [{units.length}]")
    for spine in ax.spines.values():
        spine.set_visible(True)
    handles: list[Any] = [
        Patch(fc=palette.PAPER, ec=palette.DESIGN, lw=0.6, label="design"),
        Line2D([], [], color=palette.DESIGN, lw=0.7, ls=dashes, label="alignment"),
    ]
    known, names = ax.get_legend_handles_labels()
    handles += [h for h, name in zip(known, names) if name in ("check shot", "benchmark", "buried utility")]
    figure.legend(handles=handles, loc="outside upper left", ncols=5, handlelength=2.2)
    _colour_bar(figure, ax, norm, inputs, units)
    _to_scale(figure, ax)
    busy = [sheet.place(part) for part in corners]
    _north_and_scale(ax, np.concatenate(busy), units)
    return figure


def _to_scale(figure: Figure, ax: Axes) -> None:
    """Show as much more ground as makes both axes of one scale, and freeze the layout.

    matplotlib's own equal aspect moves the axes after the layout has been made, and labels off the figure.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    frame = ax.get_window_extent()
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    scale = max((right - left) / frame.width, (top - bottom) / frame.height)
    x, y = (left + right) / 2, (bottom + top) / 2
    ax.set_xlim(x - scale * frame.width / 2, x + scale * frame.width / 2)
    ax.set_ylim(y - scale * frame.height / 2, y + scale * frame.height / 2)


def _coordinate(value: float) -> str:
    return text_of(value, 0 if abs(value - round(value)) < 1e-6 else 1)


def _near(centre: np.ndarray, line: Alignment, grid: Grid) -> np.ndarray:
    """The part of a long alignment that runs along the cells, or the plan would shrink the trench to a dot."""
    part = np.linspace(grid.station[0], grid.station[-1], 50)
    reach = 0.1 * (part[-1] - part[0])
    part = np.clip([part[0] - reach, *part, part[-1] + reach], line.start_station, line.end_station)
    return line.points(part, 0.0)


def _cells(ax: Axes, grid: Grid, line: Alignment, sheet: Sheet, norm: Normalize, units: Units) -> None:
    take = slice(None, None, max(1, len(grid.station) // MAX_PLAN_COLUMNS))
    station, image = grid.station[take], grid.values["deviation"][:, take]
    ds = float(station[1] - station[0]) if len(station) > 1 else grid.cell_m[0]
    do = grid.cell_m[1]
    edge_s = np.append(station - ds / 2, station[-1] + ds / 2)
    edge_o = np.append(grid.offset - do / 2, grid.offset[-1] + do / 2)
    corner = sheet.place(line.points(*np.meshgrid(edge_s, edge_o)))
    masked = np.ma.masked_invalid(units.to_deviation(image))
    # One raster image inside the SVG: as vector cells this figure alone would be six megabytes.
    ax.pcolormesh(corner[..., 0], corner[..., 1], masked, cmap=DEVIATION_MAP, norm=norm, rasterized=True)


def _outline(grid: Grid, line: Alignment) -> list[np.ndarray]:
    """Rings around the cells that have a design, one per unbroken run of stations."""
    inside = grid.values["floor"]
    columns = np.flatnonzero(inside.any(axis=0))
    if len(columns) == 0:
        return []
    ds, do = grid.cell_m
    rings = []
    for run in np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1):
        left = grid.offset[inside[:, run].argmax(axis=0)] - do / 2
        right = grid.offset[len(grid.offset) - 1 - inside[::-1, run].argmax(axis=0)] + do / 2
        station = grid.station[run].copy()
        station[0] -= ds / 2
        station[-1] += ds / 2
        keep = _corners(left, right)
        ring = [line.points(station[keep], left[keep]), line.points(station[keep], right[keep])[::-1]]
        rings.append(np.concatenate(ring))
    return rings


def _corners(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Indices at which the outline turns, and every tenth besides because the alignment may bend."""
    turns = np.zeros(len(left), bool)
    turns[[0, -1]] = True
    turns[::10] = True
    jump = (np.diff(left) != 0) | (np.diff(right) != 0)
    turns[:-1] |= jump
    turns[1:] |= jump
    return np.flatnonzero(turns)


def _station_marks(ax: Axes, line: Alignment, sheet: Sheet, grid: Grid, units: Units) -> None:
    """Ticks across the alignment at round stations, with their value."""
    first, last = units.to_length([grid.station[0], grid.station[-1]])
    ticks = [t for t in MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(first, last) if first <= t <= last]
    reach = float(np.abs(grid.offset[grid.values["floor"].any(axis=1)]).max()) + 0.15
    for tick in ticks:
        ends = sheet.place(line.points(np.array(tick / units.per_metre), np.array([-reach, reach])))
        ax.plot(*ends.T, color=palette.MUTED, lw=0.6)
        away = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        ax.annotate(
            text_of(tick, 0),
            tuple(ends[1]),
            tuple(9 * away),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=6.5,
            color=palette.MUTED,
        )


def _colour_bar(figure: Figure, ax: Axes, norm: Normalize, inputs: ReportInputs, units: Units) -> None:
    bar = figure.colorbar(
        ScalarMappable(norm, DEVIATION_MAP), ax=ax, extend="both", aspect=28, pad=0.015, fraction=0.05
    )
    bar.outline.set_linewidth(0.4)
    bar.set_label(f"− low (over-dug)   deviation [{units.deviation}]   + high (under-dug)", fontsize=7)
    bar.ax.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: text_of(value, units.deviation_digits, True))
    )
    for limit in (inputs.site.tolerance.high_mm, -inputs.site.tolerance.low_mm):
        bar.ax.axhline(float(units.to_deviation(limit / 1000)), color=palette.INK, lw=1.0)


def _north_and_scale(ax: Axes, busy: np.ndarray, units: Units) -> None:
    """North arrow and a scale bar of a round length, in the two corners that are freest."""
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    width, height = right - left, top - bottom
    at = (busy - [left, bottom]) / [width, height]
    corners = [(0.86, 0.88), (0.14, 0.1), (0.86, 0.1), (0.14, 0.88)]
    free = sorted(corners, key=lambda c: -float(np.min(np.hypot(*(at - c).T))))
    (nx, ny), (bx, by) = free[0], free[1]
    ax.annotate(
        "N",
        (nx, min(ny + 0.07, 0.96)),
        (nx, min(ny + 0.07, 0.96) - 0.36 / (0.78 * WIDTH_IN * height / width)),
        xycoords="axes fraction",
        textcoords="axes fraction",
        ha="center",
        va="top",
        fontsize=8,
        fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "lw": 1.0, "fc": palette.INK, "ec": palette.INK},
    )
    wish = 0.16 * width
    power = 10.0 ** np.floor(np.log10(wish))
    length = max(step * power for step in (1, 2, 5) if step * power <= wish)
    x, y = left + bx * width - length / 2, bottom + by * height
    thick = 0.008 * max(width, height)
    for part, colour in ((0, palette.INK), (1, palette.PAPER)):
        bar = Rectangle(
            (x + part * length / 2, y), length / 2, thick, fc=colour, ec=palette.INK, lw=0.6, zorder=5
        )
        ax.add_patch(bar)
    ax.annotate(
        f"{text_of(length, 0 if length >= 1 else 1)} {units.length}",
        (x + length / 2, y + thick),
        (0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=7,
        zorder=5,
    )


def deviation_map(inputs: ReportInputs, grid: Grid, units: Units) -> Figure:
    """Cells by station and offset; offset to the right of the alignment downwards, as one walks along."""
    figure = new_figure(2.7)
    ax = figure.subplots()
    reach = scale_of(inputs, grid)
    norm = Normalize(-float(units.to_deviation(reach)), float(units.to_deviation(reach)))
    take = slice(None, None, max(1, len(grid.station) // MAX_MAP_COLUMNS))
    deviation, state = grid.values["deviation"][:, take], grid.values["state"][:, take]
    image = DEVIATION_MAP(norm(units.to_deviation(np.nan_to_num(deviation))))
    known = np.isfinite(deviation)
    image[~known] = to_rgba(palette.NEVER_TOUCHED)
    image[~known & (state != "never touched")] = to_rgba(palette.PASSED_OVER)
    ds, do = grid.cell_m
    extent = units.to_length(
        [
            grid.station[0] - ds / 2,
            grid.station[-1] + ds / 2,
            grid.offset[-1] + do / 2,
            grid.offset[0] - do / 2,
        ]
    )
    pixels = (np.clip(image, 0, 1) * 255).round().astype(np.uint8)
    ax.imshow(pixels, extent=tuple(extent.tolist()), aspect="auto", interpolation="none", origin="upper")
    inside = grid.values["floor"]
    columns = np.flatnonzero(inside.any(axis=0))
    if len(columns):
        x = units.to_length(grid.station[columns])
        for edge in (
            grid.offset[inside[:, columns].argmax(axis=0)] - do / 2,
            grid.offset[len(grid.offset) - 1 - inside[::-1, columns].argmax(axis=0)] + do / 2,
        ):
            ax.plot(x, units.to_length(edge), color=palette.DESIGN, lw=0.6)
    ax.grid(False)
    ax.set_xlabel(f"Station [{units.length}]")
    ax.set_ylabel(f"Offset [{units.length}], right is +")
    handles = [
        Patch(fc=palette.PASSED_OVER, ec=palette.MUTED, lw=0.4, label="passed over"),
        Patch(fc=palette.NEVER_TOUCHED, ec=palette.MUTED, lw=0.4, label="never touched"),
        Patch(fc="none", ec=palette.DESIGN, lw=0.6, label="design"),
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=3, handlelength=1.4)
    bar = figure.colorbar(
        ScalarMappable(norm, DEVIATION_MAP), ax=ax, extend="both", pad=0.015, fraction=0.05, aspect=16
    )
    bar.outline.set_linewidth(0.4)
    bar.set_label(f"Deviation [{units.deviation}]")
    bar.ax.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: text_of(value, units.deviation_digits, True))
    )
    return figure
