"""Figures of a plan: U along the trench, and maps with ellipses of the worst direction."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from pipeline.planning.outcome import Map, Plan
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.words import Words

SIGMA_MAP = LinearSegmentedColormap.from_list("sigma", palette.LOW_TO_HIGH[4:])
"""Pale is sure, dark orange is not."""


def line_figure(plan: Plan, words: Words) -> Figure:
    """U of the elevation and its parts over the station."""
    figure = new_figure(2.4)
    ax = figure.subplots()
    k, line = 1e3 * plan.coverage_factor, plan.line
    ax.plot(line.station, k * line.sigma_h, color=palette.INK, marker="o", ms=2.5,
            label=words("planning.u", k=plan.coverage_factor))  # fmt: skip
    ax.plot(line.station, k * line.own, color=palette.ACCENTS[0], lw=0.9, label=words("planning.own"))
    ax.plot(
        line.station,
        k * line.common,
        color=palette.ACCENTS[1],
        lw=0.9,
        ls="--",
        label=words("planning.common"),
    )
    ax.axhline(1e3 * plan.half_tolerance_m, color=palette.MUTED, lw=0.9, ls=(0, (6, 2)))
    ax.annotate(words("planning.half"), (0.0, 1e3 * plan.half_tolerance_m), (2, 2),
                xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=7)  # fmt: skip
    seen = line.sigma_h[np.isfinite(line.sigma_h)]
    top = max(2.0 * plan.half_tolerance_m, 1.2 * plan.coverage_factor * float(np.min(seen, initial=0.05)))
    ax.set_ylim(0, 1e3 * top)
    ax.set_xlim(line.station[0], line.station[-1])
    ax.set_xlabel("station, m")
    ax.set_ylabel("mm")
    ax.legend(loc="upper right", ncols=3)
    return figure


def scale_of_ellipses(drawn: Map) -> float:
    """How many times as large one sigma is drawn: a round number that keeps ellipses apart."""
    if not drawn.ellipses:
        return 1.0
    typical = np.sqrt(np.median([np.linalg.eigvalsh(c)[-1] for _, _, c in drawn.ellipses]))
    room = 0.03 * (drawn.x[-1] - drawn.x[0])
    power = 10.0 ** np.floor(np.log10(room / typical))
    return float(max(power * max(b for b in (1, 2, 5) if b * power <= room / typical), 1.0))


def map_figure(drawn: Map, x_label: str, y_label: str, words: Words, times: float, top_mm: float) -> Figure:
    """A map of the sigma of the elevation up to ``top_mm``, to scale, with ellipses of one sigma drawn larger."""
    size = drawn.x[-1] - drawn.x[0], drawn.y[-1] - drawn.y[0]
    figure = new_figure(float(np.clip(5.6 * size[1] / size[0] + 0.5, 2.4, 5.6)))
    ax = figure.subplots()
    value = 1e3 * drawn.sigma_h
    step = [np.diff(a).mean() / 2 for a in (drawn.x, drawn.y)]
    extent = (
        *(drawn.x[0] - step[0], drawn.x[-1] + step[0]),
        *(drawn.y[0] - step[1], drawn.y[-1] + step[1]),
    )
    image = ax.imshow(
        value, origin="lower", extent=extent, cmap=SIGMA_MAP, vmin=0, vmax=top_mm, interpolation="nearest"
    )
    rings = []
    for x, y, cov in drawn.ellipses:
        values, vectors = np.linalg.eigh(cov)
        wide, high = 2 * times * np.sqrt(np.maximum(values[::-1], 0.0))
        turn = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
        rings.append(Ellipse((x, y), wide, high, angle=turn))
    ax.add_collection(PatchCollection(rings, facecolor="none", edgecolor=palette.INK, linewidth=0.7))
    ax.set_aspect("equal")
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    figure.colorbar(image, ax=ax, shrink=0.8, label=f"{words('planning.sigma')}, mm", extend="max")
    return figure


def distance_figure(distance_m, series, words: Words) -> Figure:
    """Largest sigma of a marker's place over its distance, one line per camera and marker, logarithmic axes."""
    figure = new_figure(2.6)
    ax = figure.subplots()
    for k, (name, sigma_mm) in enumerate(series):
        ax.loglog(
            distance_m,
            sigma_mm,
            marker="osD^v"[k % 5],
            ms=3,
            ls=("-", "--", ":", "-.")[k % 4],
            color=palette.ACCENTS[k % len(palette.ACCENTS)],
            label=name,
        )
    ax.set_xticks(distance_m, [f"{d:g}" for d in distance_m])
    ax.minorticks_off()
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.set_xlabel(f"{words('planning.distance')}, m")
    ax.set_ylabel("mm")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure
