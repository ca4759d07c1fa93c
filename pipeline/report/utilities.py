"""Buried utilities on the page: the table of lines, the approaches, their figure, and the lines on the plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.report import numbers, palette
from pipeline.report.drawing import new_figure
from pipeline.report.facts import station_text
from pipeline.report.inputs import ReportInputs
from pipeline.report.numbers import column, duration_text
from pipeline.report.units import Units, text_of
from pipeline.report.words import Words
from pipeline.surface.utilities import NEAR_MISS, NOT_APPROACHED, STRIKE_LIKELY, STRIKE_POSSIBLE, VERDICTS

MOST_EVENTS = 50
MOST_DRAWN = 20
"""Lines of the figure, the gravest first."""
DASHES: dict[str, Any] = {
    "gas": (0, (4, 1.2)),
    "water": (0, (9, 3)),
    "power": (0, (2, 1.5)),
    "telecom": (0, (1, 1.2)),
    "sewer": (0, (10, 2, 2, 2, 2, 2)),
    "other": "-",
}
"""How the kinds are told apart on the plan, besides their word."""

Line = dict[str, Any]


def lines_of(inputs: ReportInputs) -> list[Line]:
    """What `survey.json` says of each utility, the gravest first, by lower bound within a verdict."""
    found = list((inputs.survey.get("utilities") or {}).get("lines") or ())
    far = float("inf")
    return sorted(
        found,
        key=lambda line: (VERDICTS.index(line["verdict"]), far if line["bound"] is None else line["bound"]),
    )


def section(inputs: ReportInputs, units: Units, words: Words) -> dict[str, Any] | None:
    """Tables and sentences of the section; None where the site has no utilities."""
    if not inputs.site.utilities:
        return None
    lines = lines_of(inputs)
    counted = [sum(line["approaches"].values()) for line in lines]
    events, listed = _events_table(inputs, units, words)
    return {
        "rule": words(
            "utilities.rule", reach=_distance_text((inputs.survey.get("utilities") or {}).get("reach"), units)
        ),
        "bias": words("utilities.bias"),
        "why": "" if lines else words("page.not_available", why=inputs.why_missing("survey.json")),
        "lines": _lines_table(lines, units, words),
        "counted": words("utilities.counted", n=sum(counted), listed=listed),
        "events": events,
        "unseen": unseen(inputs, units, words),
    }


def _lines_table(lines: list[Line], units: Units, words: Words) -> dict[str, Any]:
    length, digits = units.length, units.length_digits
    columns = [
        column("name", words("columns.utility"), kind="id"),
        column("kind", words("columns.kind")),
        column("verdict", words("columns.verdict"), kind="judged"),
        column("distance", words("columns.distance"), length, digits, signed=True),
        column("bound", words("columns.bound"), length, digits, signed=True),
        column("clearance", words("columns.clearance"), length, digits),
        column("sigma_edge", words("columns.sigma_edge"), length, digits),
        column("sigma_line", words("columns.sigma_line"), length, digits),
        column("station", words("columns.station"), length, units.station_digits),
        column("offset", words("columns.offset"), length, units.station_digits, signed=True),
        column("time", words("columns.time")),
        column("approaches", words("columns.approaches"), "", 0),
        column("unseen", words("columns.unseen"), "s", 1),
    ]
    rows = []
    for line in lines:
        seen = line["distance"] is not None
        row = {
            key: _length(line[key], units)
            for key in ("distance", "bound", "clearance", "sigma_line", "station", "offset")
        }
        edge = float(np.hypot(line["sigma_own"], line["sigma_common"])) if seen else None
        rows.append(
            {
                **row,
                "name": line["name"],
                "kind": words(f"kinds.{line['kind']}"),
                "verdict": line["verdict"],
                "sigma_edge": _length(edge, units),
                "time": numbers.utc_text(line["time_ns"], 1) if seen else "",
                "approaches": sum(line["approaches"].values()),
                "unseen": line["unseen"]["seconds"],
            }
        )
    return numbers.table(columns, rows)


def _events_table(inputs: ReportInputs, units: Units, words: Words) -> tuple[dict[str, Any], int]:
    """Approaches below the clearance, the gravest first, and how many of them are listed."""
    length, digits = units.length, units.length_digits
    columns = [
        column("utility", words("columns.utility"), kind="id"),
        column("verdict", words("columns.verdict"), kind="judged"),
        column("distance", words("columns.distance"), length, digits, signed=True),
        column("bound", words("columns.bound"), length, digits, signed=True),
        column("station", words("columns.station"), length, units.station_digits),
        column("offset", words("columns.offset"), length, units.station_digits, signed=True),
        column("h", words("columns.edge_h"), length, digits),
        column("time", words("columns.time")),
        column("start", words("columns.start")),
        column("seconds", words("columns.seconds"), "s", 1),
    ]
    found = inputs.table("utilities")
    rows: list[dict[str, Any]] = []
    if found is not None:
        grave = np.array([VERDICTS.index(verdict) for verdict in found["verdict"]])
        near = np.flatnonzero(grave <= VERDICTS.index(NEAR_MISS))
        order = near[np.lexsort((found["time_ns"][near], found["bound"][near], grave[near]))]
        for i in order[:MOST_EVENTS]:
            row = {
                key: _length(found[key][i], units) for key in ("distance", "bound", "station", "offset", "h")
            }
            row |= {key: found[key][i] for key in ("utility", "verdict")}
            row |= {
                "time": numbers.utc_text(found["time_ns"][i], 1),
                "start": numbers.utc_text(found["start_ns"][i], 1),
            }
            rows.append({**row, "seconds": (found["end_ns"][i] - found["start_ns"][i]) * 1e-9})
    return numbers.table(columns, rows), len(rows)


def _length(metres: Any, units: Units) -> Any:
    return None if metres is None else units.to_length(metres)


def _distance_text(metres: float | None, units: Units) -> str:
    if metres is None:
        return text_of(None, 0)
    return f"{text_of(float(units.to_length(metres)), units.station_digits)} {units.length}"


def struck(inputs: ReportInputs, units: Units, words: Words) -> list[str]:
    """A sentence for each line that the edge struck, or may have."""
    return [
        _sentence("likely" if line["verdict"] == STRIKE_LIKELY else "possible", line, units, words)
        for line in lines_of(inputs)
        if line["verdict"] in (STRIKE_LIKELY, STRIKE_POSSIBLE)
    ]


def nearly(inputs: ReportInputs, units: Units, words: Words) -> list[str]:
    """A sentence for each line that the edge came nearer than its clearance."""
    return [
        _sentence("near", line, units, words) for line in lines_of(inputs) if line["verdict"] == NEAR_MISS
    ]


def unseen(inputs: ReportInputs, units: Units, words: Words) -> list[str]:
    """A sentence for each line near which the edge was not seen for some time."""
    told = (inputs.survey.get("utilities") or {}).get("reach")
    return [
        words(
            "utilities.unseen",
            line=_named(line, words),
            reach=_distance_text(told, units),
            seconds=duration_text(line["unseen"]["seconds"]),
            n=line["unseen"]["stretches"],
            longest=duration_text(line["unseen"]["longest_seconds"]),
            time=numbers.utc_text(line["unseen"]["longest_from_ns"]),
        )
        for line in lines_of(inputs)
        if line["unseen"]["stretches"]
    ]


def _sentence(key: str, line: Line, units: Units, words: Words) -> str:
    return words(
        f"utilities.{key}",
        line=_named(line, words),
        distance=_distance_text(line["distance"], units),
        bound=_distance_text(line["bound"], units),
        clearance=_distance_text(line["clearance"], units),
        station=station_text(line["station"], units),
        time=numbers.utc_text(line["time_ns"]),
    )


def _named(line: Line, words: Words) -> str:
    return words("utilities.named", kind=words(f"kinds.{line['kind']}"), name=line["name"])


def described(inputs: ReportInputs, units: Units, words: Words) -> str:
    """The lines and their distances in words, for the figure's description."""
    return "; ".join(
        f"{_named(line, words)}: {line['verdict']}, {_distance_text(line['distance'], units)}, "
        f"{words('utilities.at_least', bound=_distance_text(line['bound'], units))}"
        for line in lines_of(inputs)[:MOST_DRAWN]
    )


def distances(inputs: ReportInputs, units: Units, words: Words) -> Figure:
    """One row per line, the gravest on top: nearest distance with its bound, further approaches as ticks."""
    lines = lines_of(inputs)[:MOST_DRAWN]
    events = inputs.table("utilities")
    figure = new_figure(0.95 + 0.36 * len(lines))
    ax = figure.subplots()
    known = [
        v
        for line in lines
        for v in (line["distance"], line["bound"])
        if v is not None and line["verdict"] != NOT_APPROACHED
    ]
    right = 1.08 * max([1.6 * max(line["clearance"] for line in lines), *known])
    left = min([-0.08 * right, *(1.15 * v for v in known)])
    ax.set_xlim(units.to_length(left), units.to_length(right))
    ax.axvspan(units.to_length(left), 0, color=palette.BAND, lw=0)
    ax.axvline(0, color=palette.DESIGN, lw=0.9)
    for row, line in enumerate(lines):
        style = palette.verdict_style(line["verdict"])
        ax.plot(
            units.to_length(line["clearance"]), row, "|", color=palette.DESIGN, ms=13, mew=1.0,
            label="clearance" if row == 0 else None,
        )  # fmt: skip
        if events is not None:
            more = (events["utility"] == line["name"]) & ~events["nearest"]
            ax.plot(
                units.to_length(events["distance"][more]), np.full(int(more.sum()), row), "|", color=palette.AS_BUILT,
                ms=6, mew=0.6, label="further approaches" if row == 0 else None,
            )  # fmt: skip
        if line["distance"] is None:
            continue
        at = min(line["distance"], 0.985 * right)
        ax.plot(units.to_length([min(line["bound"], at), at]), [row, row], color=style.ink, lw=1.6)
        beyond = line["distance"] > at
        ax.plot(units.to_length(at), row, ">" if beyond else style.marker, color=style.ink, ms=6)
    names = [
        f"{_named(line, words)}\n{palette.verdict_style(line['verdict']).symbol} {line['verdict']}"
        for line in lines
    ]
    ax.set_yticks(range(len(lines)), names)
    ax.set_ylim(len(lines) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel(f"Distance from the edge to the line's surface [{units.length}]; grey: inside it")
    figure.legend(loc="outside upper right", ncols=2, handlelength=1.2)
    return figure


def draw_on_plan(ax: Axes, inputs: ReportInputs, place: Callable[[np.ndarray], np.ndarray]) -> None:
    """Lines of the plan by kind with their word, and where the edge came nearest to each; call with the limits set."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    nearest = inputs.table("utilities")
    first = True
    for number, utility in enumerate(inputs.utilities):
        line = utility.line
        start, end = place(line.start[:, :2]), place(line.end[:, :2])
        share = np.linspace(0, 1, 60)[:, None, None]
        along = (start + share * (end - start)).transpose(1, 0, 2).reshape(-1, 2)
        margin = 0.04 * np.array([right - left, top - bottom])
        inside = np.all((along > [left, bottom] + margin) & (along < [right, top] - margin), axis=1)
        if not inside.any():
            continue
        gap = np.full((len(start), 1, 2), np.nan)
        drawn = np.concatenate([start[:, None], end[:, None], gap], axis=1).reshape(-1, 2)
        ax.plot(
            *drawn.T,
            color=palette.MUTED,
            lw=1.1,
            ls=DASHES[utility.kind],
            label="buried utility" if first else None,
        )
        first = False
        seen = np.flatnonzero(inside)
        at = along[seen[-1 - 4 * number % len(seen)]]  # words of lines that lie together stand apart
        ax.annotate(
            f"{utility.kind} {utility.name}", tuple(at), (3, 3), textcoords="offset points", fontsize=6.5,
            color=palette.MUTED, ha="right" if at[0] > (left + right) / 2 else "left",
        )  # fmt: skip
        if nearest is not None:
            for i in np.flatnonzero((nearest["utility"] == utility.name) & nearest["nearest"]):
                style = palette.verdict_style(str(nearest["verdict"][i]))
                spot = place(np.array([nearest["e"][i], nearest["n"][i]]))
                ax.plot(*spot, style.marker, ms=6, mfc="white", mec=style.ink, mew=1.4, ls="")
