"""Figures of the page beside the paper: its Figs. 7 to 9, 11 and 13 as ours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from pipeline.report import palette
from pipeline.report.drawing import new_figure

INCH_MM = 25.4


def histogram(values, label: str) -> Figure:
    """How often what."""
    figure = new_figure(1.9)
    ax = figure.subplots()
    ax.hist(values, bins=24, color=palette.ACCENTS[0])
    ax.set_xlabel(label)
    ax.set_ylabel("poses")
    return figure


def curves(x, series: Sequence[tuple[str, np.ndarray]], x_label: str) -> Figure:
    """Sigmas in mm over something, on logarithmic axes."""
    figure = new_figure(2.4)
    ax = figure.subplots()
    for k, (name, y) in enumerate(series):
        ax.loglog(
            x, y, marker="o", ms=2.5, ls=("-", "--", ":", "-.")[k % 4], color=palette.ACCENTS[k], label=name
        )
    # The page draws no mathematics: powers of ten as plain numbers, at places of our own.
    places = np.asarray(x)[:: max(len(x) // 6, 1)]
    ax.set_xticks(places, [f"{p:.0f}" if p >= 100 else f"{p:.1f}" for p in places])
    drawn = np.concatenate([np.ravel(y) for _, y in series])
    steps = np.outer(10.0 ** np.arange(-3, 4), [1, 2, 5]).ravel()
    steps = steps[(steps >= 0.9 * drawn.min()) & (steps <= 1.1 * drawn.max())]
    ax.set_yticks(steps, [f"{step:g}" for step in steps])
    ax.minorticks_off()
    ax.set_xlabel(x_label)
    ax.set_ylabel("sigma, mm")
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


def boxes(series: Sequence[tuple[str, Sequence[str], Sequence[np.ndarray]]]) -> Figure:
    """Absolute depth errors in mm as quartile boxes, one frame per series, the inch as a dashed line."""
    figure = new_figure(4.4)
    for ax, (label, names, values) in zip(figure.subplots(2, 2).ravel(), series, strict=True):
        ax.boxplot(
            [v[np.isfinite(v)] for v in values],
            tick_labels=list(names),
            whis=(0, 100),
            medianprops={"color": palette.CHECK},
            boxprops={"color": palette.AS_BUILT},
        )
        ax.axhline(INCH_MM, color=palette.MUTED, ls=(0, (6, 2)), lw=0.9)
        ax.set_ylim(0, 28)
        ax.set_xlabel(label)
        ax.set_ylabel("error of depth, mm")
    return figure
