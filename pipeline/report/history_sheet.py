"""The sheet of dated machine files: what moved from one calibration to the next, and what has grown old."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from pipeline.calibration.drift import Change
from pipeline.report import palette
from pipeline.report.drawing import new_figure
from pipeline.report.numbers import column, number, table
from pipeline.report.sheet import GOOD, POOR, Part, Picture, Sheet
from pipeline.report.words import Words

MARKS = ("o", "s", "^", "D", "v", "P", "X")
MOST_DRAWN = 7
"""Quantities in the picture, those that moved most; the table has all."""


def history_sheet(
    found: Mapping[str, Sequence[Change]],
    sentences: Sequence[str],
    distance_m: float,
    today: datetime.date,
    subject: str,
    origin: Mapping[str, str],
    language: str = "en",
) -> Sheet:
    """The page of a machine's calibrations.

    Parameters
    ----------
    found : mapping
        Key -> changes, oldest first.
    sentences : sequence of str
        What needs attention.
    distance_m : float
        To the cutting edge.
    today : date
        Against which ages were counted.
    subject, origin
        As `Sheet` has them.
    language : str
        Of the words.
    """
    words = Words(language)
    changes = [change for several in found.values() for change in several]
    moved = [change for change in changes if change.edge_mm is not None]
    furthest = max(moved, key=lambda change: change.edge_mm or 0.0, default=None)
    ages = [several[-1] for several in found.values() if several[-1].age_days is not None]
    oldest = max(ages, key=lambda change: change.age_days or 0, default=None)
    numbers = [(words("history.quantities"), number(len(found), "", 0), "")]
    if furthest is not None:
        numbers.append((words("history.furthest"), number(furthest.edge_mm, "mm", 1), furthest.key))
    if oldest is not None:
        numbers.append((words("history.oldest"), number(oldest.age_days, "d", 0), oldest.key))
    state = POOR if sentences else GOOD
    return Sheet(
        title=words("history.title"),
        subject=subject,
        state=state,
        sentence=words(f"history.{state}", count=str(len(sentences))),
        stamp=words(f"history.stamp_{state}"),
        numbers=numbers,
        remarks=list(sentences),
        parts=[
            Part(
                words("history.by_quantity"),
                [words("history.text", distance=f"{distance_m:g}", day=today.isoformat())],
                [(words("history.caption"), _rows(changes, words))],
                [_picture(found, words)] if any(change.date for change in moved) else [],
            )
        ],
        origin=origin,
    )


def _rows(changes: Sequence[Change], words: Words) -> dict:
    columns = [
        column("key", words("history.quantity"), kind="code"),
        column("date", words("history.date")),
        column("by", words("history.by")),
        column("sigmas", words("history.sigmas"), digits=1),
        column("edge", words("history.edge"), "mm", 1),
        column("age", words("history.age"), "d", 0),
    ]
    rows = [
        {
            "key": change.key,
            "date": change.date.isoformat() if change.date else words("history.no_date"),
            "by": change.by,
            "sigmas": change.sigmas,
            "edge": change.edge_mm,
            "age": change.age_days,
        }
        for change in changes
    ]
    return table(columns, rows)


def _picture(found: Mapping[str, Sequence[Change]], words: Words) -> Picture:
    dated = {
        key: [c for c in several if c.date is not None and c.edge_mm is not None]
        for key, several in found.items()
    }
    drawn = sorted(
        (key for key, several in dated.items() if several),
        key=lambda key: -max(c.edge_mm or 0.0 for c in dated[key]),
    )[:MOST_DRAWN]

    def draw() -> Figure:
        figure = new_figure(2.4)
        axes = figure.subplots()
        for k, key in enumerate(drawn):
            axes.plot(
                [c.date.toordinal() for c in dated[key] if c.date],
                [c.edge_mm or 0.0 for c in dated[key]],
                MARKS[k % len(MARKS)],
                ms=4,
                color=palette.ACCENTS[k % len(palette.ACCENTS)],
                label=key,
            )
        days = sorted({c.date for key in drawn for c in dated[key] if c.date is not None})
        axes.set_xticks([day.toordinal() for day in days], [day.isoformat() for day in days], rotation=20)
        axes.margins(x=0.1)
        axes.set_ylabel(words("history.axis_edge"))
        axes.set_ylim(bottom=0)
        axes.legend()
        return figure

    return Picture(
        "history",
        words("history.picture"),
        words("history.picture_good"),
        words("history.picture_seen"),
        draw,
    )
