"""Evidence for the worst stations: the frames of the pass that made their floor, with what was seen in them.

A frame is drawn in its camera's own pixels, so that corners stand where the tables have them, however small the
picture was made.
"""

from __future__ import annotations

import base64
from html import escape
from typing import Any

import numpy as np

from pipeline.report import numbers, palette
from pipeline.report.facts import deviation_text, station_text
from pipeline.report.inputs import ReportInputs, View
from pipeline.report.moments import Moment
from pipeline.report.numbers import column
from pipeline.report.units import Units
from pipeline.report.words import Words

ACCEPTED = "accepted"
ENLARGED = (200, 100, 50, 20, 10, 5, 2, 1)
"""Residuals are tenths of a pixel and would not be seen; the largest that keeps them near their corners is taken."""
LONGEST = 0.03
"""Of the picture's width, the longest stroke of a residual."""
PAGE_WIDTH = 900.0
"""Sizes of lines and letters below are for a picture this wide."""


def evidence(
    inputs: ReportInputs, units: Units, words: Words
) -> tuple[dict[str, Any], dict[str, str], dict[str, dict[str, str]]]:
    """What the page says of the worst stations, the pictures as SVG by name, and title and so on of each."""
    views: list[dict[str, Any]] = []
    pictures: dict[str, str] = {}
    about: dict[str, dict[str, str]] = {}
    for view in inputs.views:
        name = f"view_{len(views)}"
        about[name] = _about(view, units, words)
        tags = tags_table(view, words) if view.jpeg and len(view.tags.get("tag", ())) else None
        if view.jpeg:
            pictures[name] = _svg(view, f"figure-{name}", about[name], words)
        views.append({"figure": name, "tags": tags})
    moments = [_sentence(moment, units, words) for moment in inputs.moments]
    why = "" if moments else words("page.not_available", why=words("evidence.none"))
    return {"moments": moments, "views": views, "why": why}, pictures, about


def _sentence(moment: Moment, units: Units, words: Words) -> str:
    """When the floor of a station was made."""
    return words(
        "evidence.moment",
        station=station_text(moment.station, units),
        deviation=deviation_text(moment.deviation, units),
        u=deviation_text(moment.expanded_uncertainty, units, signed=False),
        verdict=moment.verdict,
        cells=moment.cells,
        all=moment.of_cells,
        time=numbers.utc_text(moment.time_ns, 1)[11:],
    )


def _about(view: View, units: Units, words: Words) -> dict[str, str]:
    status = view.tags.get("status", np.zeros(0, object))
    rejected = [f"{t} ({s})" for t, s in zip(view.tags.get("tag", ()), status) if s != ACCEPTED]
    places = {
        "stations": ", ".join(station_text(station, units) for station in view.stations),
        "camera": view.camera,
        "time": numbers.utc_text(view.time_ns, 2)[11:],
    }
    good = words("figures.view.good")
    if view.jpeg and _adjusted(view).any():
        good += " " + words("evidence.strokes", n=enlargement(view))
    described = words(
        "figures.view.description",
        accepted=int((status == ACCEPTED).sum()),
        rejected=len(rejected),
        listed=", ".join(rejected) or words("evidence.nothing"),
        **places,
    )
    return {
        "title": words("figures.view.title", **places),
        "good": good,
        "description": "" if view.why else described,
        "why": words("page.not_available", why=view.why) if view.why else "",
    }


def outcome(status: str, weight: float) -> str:
    """``used``, ``gross`` (accepted, and given no weight), ``unused`` (accepted, and not adjusted) or ``rejected``."""
    if status != ACCEPTED:
        return "rejected"
    return "unused" if np.isnan(weight) else "used" if weight > 0 else "gross"


def tags_table(view: View, words: Words) -> dict[str, Any]:
    """The tags of a frame: those that were not used first, with what that means."""
    columns = [
        column("tag", words("columns.tag"), kind="id"),
        column("marker", words("columns.marker")),
        column("status", words("columns.result")),
        column("rms_px", words("columns.rms_px"), "px", 3),
        column("normalised", words("columns.worst_corner"), "", 1),
        column("weight", words("columns.least_weight"), "", 2),
        column("meaning", words("columns.meaning"), kind="why"),
    ]
    tags = view.tags
    offset = np.sum((tags["uv"] - tags["predicted"]) ** 2, axis=-1)
    rows = []
    for i, status in enumerate(tags["status"]):
        kind = outcome(status, tags["weight"][i])
        reason = words(f"reasons.{status}") if words.has(f"reasons.{status}") else ""
        rows.append(
            {
                "tag": tags["tag"][i],
                "marker": tags["marker"][i],
                "status": status if kind == "rejected" else words(f"evidence.{kind}"),
                "rms_px": np.sqrt(offset[i].mean() / 2),  # per component, as everywhere on the page
                "normalised": tags["normalised"][i],
                "weight": tags["weight"][i],
                "meaning": reason if kind == "rejected" else "",
                "order": ("rejected", "gross", "unused", "used").index(kind),
            }
        )
    rows.sort(key=lambda row: row["order"])
    return numbers.table(columns, rows)


def _adjusted(view: View) -> np.ndarray:
    """(n,) tags that have predicted corners."""
    predicted = view.tags.get("predicted", np.zeros((0, 4, 2)))
    return np.asarray(np.isfinite(predicted).reshape(len(predicted), 8).all(axis=1))


def enlargement(view: View) -> int:
    """How many times larger than they are the residuals of a frame are drawn."""
    known = _adjusted(view)
    longest = float(np.linalg.norm((view.tags["predicted"] - view.tags["uv"])[known], axis=-1).max())
    fits = [times for times in ENLARGED if times * longest <= LONGEST * view.width]
    return fits[0] if fits else 1


def _svg(view: View, name: str, about: dict[str, str], words: Words) -> str:
    """The picture with its tags; pixel centres are whole numbers, so the picture begins half a pixel before zero."""
    k = view.width / PAGE_WIDTH
    data = base64.b64encode(view.jpeg).decode("ascii")
    title, description = escape(about["title"]), escape(about["description"])
    parts = [
        f'<svg class="figure view" id="{name}" viewBox="-0.5 -0.5 {view.width} {view.height}" role="img" '
        f'aria-labelledby="{name}-title {name}-desc">'
        f'<title id="{name}-title">{title}</title><desc id="{name}-desc">{description}</desc>'
        f'<image x="-0.5" y="-0.5" width="{view.width}" height="{view.height}" preserveAspectRatio="none" '
        f'href="data:image/jpeg;base64,{data}"/>'
    ]
    if len(view.tags.get("tag", ())):
        parts += _quads(view, k)
        if _adjusted(view).any():
            parts += _predictions(view, k)
        parts += _labels(view, k, words)
    return "".join(parts) + "</svg>"


def _quads(view: View, k: float) -> list[str]:
    """The tags as they were detected: a light line on a dark one, which shows on any ground; dashed if rejected."""
    parts = []
    for uv, status in zip(view.tags["uv"], view.tags["status"]):
        points = " ".join(f"{u:.2f},{v:.2f}" for u, v in uv)
        dashed = "" if status == ACCEPTED else f' stroke-dasharray="{5 * k:.1f} {4 * k:.1f}"'
        for colour, width in ((palette.INK, 3.6), (palette.DETECTED, 1.6)):
            dash = dashed if colour == palette.DETECTED else ""
            parts.append(
                f'<polygon points="{points}" fill="none" stroke="{colour}" stroke-width="{width * k:.2f}"{dash}/>'
            )
    return parts


def _predictions(view: View, k: float) -> list[str]:
    """A cross at each corner where the solution puts it, and its residual as a stroke."""
    known = _adjusted(view)
    uv, predicted = view.tags["uv"][known], view.tags["predicted"][known]
    end = uv + enlargement(view) * (predicted - uv)
    arm = 4.5 * k
    path = []
    for (u, v), (a, b), (p, q) in zip(predicted.reshape(-1, 2), uv.reshape(-1, 2), end.reshape(-1, 2)):
        path.append(f"M{u - arm:.2f},{v:.2f}h{2 * arm:.2f}M{u:.2f},{v - arm:.2f}v{2 * arm:.2f}")
        path.append(f"M{a:.2f},{b:.2f}L{p:.2f},{q:.2f}")
    line = "".join(path)
    return [
        f'<path d="{line}" fill="none" stroke="{colour}" stroke-width="{width * k:.2f}"/>'
        for colour, width in ((palette.INK, 3.0), (palette.PREDICTED, 1.4))
    ]


def _labels(view: View, k: float, words: Words) -> list[str]:
    """Symbol, id and reason beside each tag; what was not used first, and what finds no room stands in the table."""
    size, pad = 12.0 * k, 2.5 * k
    tags = view.tags
    kinds = [outcome(s, w) for s, w in zip(tags["status"], tags["weight"])]
    low, extent = tags["uv"].min(axis=1), np.ptp(tags["uv"], axis=1)
    taken = [tuple(box) for box in np.concatenate([low, extent], axis=1).tolist()]  # no label hides a tag
    parts = []
    for i in sorted(range(len(kinds)), key=lambda i: kinds[i] == "used"):
        number = str(tags["tag"][i]).rsplit(" ", 1)[-1]
        said = {"used": "", "rejected": f" {tags['status'][i]}"}.get(kinds[i])
        text = f"{SYMBOLS[kinds[i]]} {number}{words('evidence.' + kinds[i] + '_short') if said is None else said}"
        wide, high = 0.62 * size * len(text) + 2 * pad, size + 2 * pad
        box = _room(tags["uv"][i], wide, high, 4 * k, (view.width, view.height), taken)
        if box is None:
            continue
        taken.append(box)
        x, y = box[0], box[1]
        parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{high:.1f}" rx="{2 * k:.1f}" '
            f'fill="{palette.PAPER}" stroke="{palette.INK}" stroke-width="{0.6 * k:.2f}"/>'
            f'<text x="{x + wide / 2:.1f}" y="{y + pad + 0.86 * size:.1f}" font-size="{size:.1f}" '
            f'text-anchor="middle" fill="{palette.INK}">{escape(text)}</text>'
        )
    return parts


SYMBOLS = {
    "used": "\N{CHECK MARK}",
    "rejected": "\N{MULTIPLICATION X}",
    "gross": "!",
    "unused": "\N{EN DASH}",
}


def _room(uv, wide: float, high: float, away: float, size: tuple[int, int], taken) -> tuple | None:
    """A free place above, below, right or left of a tag and inside the picture: x, y, width and height; or None."""
    (left, top), (right, bottom) = uv.min(axis=0), uv.max(axis=0)
    u, v = (left + right) / 2, (top + bottom) / 2
    for x, y in (
        (u - wide / 2, top - away - high),
        (u - wide / 2, bottom + away),
        (right + away, v - high / 2),
        (left - away - wide, v - high / 2),
    ):
        inside = x >= 0 and y >= 0 and x + wide <= size[0] - 1 and y + high <= size[1] - 1
        clear = all(x + wide <= a or a + c <= x or y + high <= b or b + d <= y for a, b, c, d in taken)
        if inside and clear:
            return float(x), float(y), wide, high
    return None
