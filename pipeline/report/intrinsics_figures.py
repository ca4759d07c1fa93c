"""Figures of the sheet on a lens: where corners were seen, what they miss by, and millimetres over the picture."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.calibration.procedure import Intrinsics
from pipeline.report import palette
from pipeline.report.drawing import new_figure

MOST_DOTS = 3000
ARROW_SIDES = 60.0
"""Arrows of residuals are drawn so that their root mean square is one such part of the picture's width."""
_LOW_TO_BAD = LinearSegmentedColormap.from_list("millimetres", [palette.PAPER, *palette.LOW_TO_HIGH[5:]])


def draw_coverage(found: Intrinsics) -> Figure:
    """Every corner of every view, with what it misses its prediction by."""
    uv = np.concatenate([view.uv.reshape(-1, 2) for view in found.views])
    residual = np.concatenate([part.reshape(-1, 2) for part in found.solution.residual_px])
    used = np.concatenate(
        [np.repeat(part, view.point.shape[1]) for part, view in zip(found.solution.used, found.views)]
    )
    step = max(len(uv) // MOST_DOTS, 1)
    uv, residual, used = uv[::step], residual[::step], used[::step]
    figure = new_figure(3.1)
    seen, missed = figure.subplots(1, 2)
    _frame(seen, found.size, "Corners of all views")
    seen.plot(*uv[used].T, ".", color=palette.AS_BUILT, markersize=1.6, label="used")
    if np.any(~used):
        seen.plot(*uv[~used].T, "x", color=palette.CHECK, markersize=3, label="left out")
        seen.legend(loc="upper left", bbox_to_anchor=(0, -0.2), ncols=2)
    scale = found.size[0] / ARROW_SIDES / max(found.solution.rms_px, 1e-6)
    _frame(
        missed,
        found.size,
        f"Observed minus predicted (RMS {found.solution.rms_px:.2f} px), enlarged {scale:,.0f} times",
    )
    missed.quiver(
        *uv[used].T, *residual[used].T * scale, angles="xy", scale_units="xy", scale=1, width=0.0018,
        color=palette.AS_BUILT,
    )  # fmt: skip
    return figure


def draw_halves(found: Intrinsics) -> Figure:
    """Where odd and even views place a tag: how far apart, beside how far they should be."""
    halves = found.halves
    assert halves is not None
    figure = new_figure(2.8)
    maps = ((halves.found_m, "Odd against even views"), (halves.predicted_m, "What chance would give"))
    top = 1000 * float(np.nanmax([np.nanmax(halves.found_m), np.nanmax(halves.predicted_m)]))
    axes = figure.subplots(1, 2)
    drawn = [
        _map(at, found.size, halves.uv, m, title, top) for at, (m, title) in zip(axes, maps, strict=True)
    ]
    figure.colorbar(drawn[0], ax=list(axes), shrink=0.85).set_label("mm")
    return figure


def draw_placing(found: Intrinsics) -> Figure:
    """Standard deviation of where a tag is seen, across and along the view; the latter is many times the former."""
    p = found.placing
    figure = new_figure(2.8)
    maps = ((p.across_m, "Across the view"), (p.along_m, "Along the view"))
    for at, (m, title) in zip(figure.subplots(1, 2), maps, strict=True):
        drawn = _map(at, found.size, p.uv, m, title, 1000 * float(np.nanmax(m)))
        figure.colorbar(drawn, ax=at, shrink=0.85).set_label("mm")
    return figure


def _map(
    at: Axes, size: tuple[int, int], uv: np.ndarray, values_m: np.ndarray, title: str, top_mm: float
) -> QuadContourSet:
    _frame(at, size, title)
    at.grid(False)
    levels = MaxNLocator(8).tick_values(0, max(top_mm, 1e-6))
    u, v = uv[..., 0], uv[..., 1]
    drawn = at.contourf(u, v, 1000 * values_m, levels=levels, cmap=_LOW_TO_BAD)
    lines = at.contour(u, v, 1000 * values_m, levels=levels, colors=palette.MUTED, linewidths=0.4)
    at.clabel(lines, levels[1::2], fmt="%g", fontsize=6.5)
    return drawn


def _frame(at: Axes, size: tuple[int, int], title: str) -> None:
    at.set_title(title)
    at.set_xlim(-0.5, size[0] - 0.5)
    at.set_ylim(size[1] - 0.5, -0.5)
    at.set_aspect("equal")
    at.set_xlabel("u, px")
    at.set_ylabel("v, px")
