"""A drawing surface for the page: matplotlib figures that become small, accessible, repeatable SVG.

The SVG of matplotlib is made for files. On a page its ids would clash between figures, its style element
would leak into everything else, and its comments and metadata (with an address in them) are ballast.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from pipeline.report import palette

WIDTH_IN = 7.6
"""Of every figure. At this width 7.5 pt are 7 pt on A4 and 13 px on a screen."""
MAX_POINTS = 1500

_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "gradetrace",
    "svg.fonttype": "path",  # the same glyphs everywhere: labels that fit here fit on any machine
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "text.parse_math": False,  # a point id may hold a dollar sign
    "text.color": palette.INK,
    "axes.labelcolor": palette.INK,
    "axes.labelsize": 7.5,
    "axes.titlesize": 7.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.edgecolor": palette.MUTED,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-9, 9),
    "grid.color": "#e1e5e9",
    "grid.linewidth": 0.5,
    "xtick.color": palette.MUTED,
    "ytick.color": palette.MUTED,
    "xtick.labelcolor": palette.INK,
    "ytick.labelcolor": palette.INK,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "figure.dpi": 72,
    "savefig.dpi": 160,
    "hatch.linewidth": 0.5,
}

DEVIATION_MAP = LinearSegmentedColormap.from_list("low_to_high", palette.LOW_TO_HIGH)
"""Blue is low (over-dug), orange is high (under-dug)."""


@contextmanager
def house_style() -> Iterator[None]:
    """The page's own style in matplotlib, whatever the user's own settings are."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure with constrained layout; call inside `house_style`."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def svg_of(figure: Figure, name: str, title: str, description: str) -> str:
    """The figure as one inline SVG element.

    Parameters
    ----------
    figure : Figure
        Drawn inside `house_style`, which must still be in force.
    name : str
        Prefix of all ids in it, unique on the page.
    title, description : str
        Plain text for those who do not see the figure; escaped here.
    """
    buffer = io.StringIO()
    FigureCanvasSVG(figure)
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=nothing)
    text = buffer.getvalue()
    head = re.search(r"<svg\b[^>]*>", text)
    assert head is not None
    box = re.search(r'viewBox="([^"]+)"', head.group())
    assert box is not None
    body = text[head.end() : text.rindex("</svg>")]
    body = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style\b.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r'(?<=\bid=")', f"{name}-", body)
    body = re.sub(r'\bxlink:href="#', f'href="#{name}-', body)
    body = body.replace("xlink:href=", "href=").replace("url(#", f"url(#{name}-")
    # A hundredth of a point cannot be seen; the glyphs' own coordinates are whole numbers anyway.
    body = re.sub(r' d="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m.group()), body)
    body = re.sub(r">\s+<", "><", body).strip()
    return (
        f'<svg class="figure" id="{name}" viewBox="{box.group(1)}" role="img" '
        f'aria-labelledby="{name}-title {name}-desc">'
        f'<title id="{name}-title">{escape(title)}</title><desc id="{name}-desc">{escape(description)}</desc>'
        f"{body}</svg>"
    )


def decimated(x: np.ndarray, y: np.ndarray, limit: int = MAX_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """A line of at most about `limit` points that keeps its spikes and its gaps.

    The lowest and the highest value of each bin of equal count stay, in their order; a NaN in a bin stays
    as a gap.

    Parameters
    ----------
    x, y : (n,) arrays
        ``x`` ascending; NaN in ``y`` is a gap.
    limit : int
        Shorter lines stay as they are.

    Returns
    -------
    two (m,) arrays
        With ``m`` at most about `limit`.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if len(x) <= limit:
        return x, y
    edges = np.linspace(0, len(x), limit // 3 + 1).astype(int)
    keep: list[int] = []
    for start, end in pairwise(edges):
        part = y[start:end]
        holes = np.flatnonzero(np.isnan(part))
        chosen = set(holes[:1].tolist())
        if len(holes) < len(part):
            chosen |= {int(np.nanargmin(part)), int(np.nanargmax(part))}
        keep += [start + i for i in sorted(chosen)]
    return x[keep], y[keep]
