"""A sheet: one page about one thing that was calibrated, surveyed or planned.

As on the report, one dict holds everything that is printed and stands beside the page as JSON; the template prints it
and computes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.report.drawing import house_style, svg_of
from pipeline.report.numbers import Number, column, table
from pipeline.report.printing import printed
from pipeline.report.words import Words

FORMAT = "gradetrace/sheet/1"
GOOD, POOR, OPEN = "good", "poor", "open"
"""Whether it is good enough; `open` where that cannot be told."""


SHARE = 1 / 3
"""Of the tolerance that ``k sigma`` of one calibration may take: the survey, the arm and the pixels want theirs."""


@dataclass(frozen=True)
class Demand:
    """What a job asks of a calibration."""

    tolerance_m: float
    """The smaller of the job's two, metres."""
    coverage_factor: float
    """k in U = k sigma."""
    distance_m: float
    """Of the cutting edge from what is calibrated."""

    def judge(self, sigma_m: float, words: Words, key: str, **places: str) -> tuple[str, str]:
        """Whether a sigma at the cutting edge is good enough, and the sentence that says so.

        The sentence stands under ``<key>.good`` or ``<key>.poor`` and may name mm, distance, limit, tolerance and k.
        """
        limit_m = SHARE * self.tolerance_m / self.coverage_factor
        state = GOOD if sigma_m <= limit_m else POOR
        said = words(
            f"{key}.{state}",
            mm=f"{1000 * sigma_m:.1f}",
            distance=f"{self.distance_m:g}",
            limit=f"{1000 * limit_m:.1f}",
            tolerance=f"{1000 * self.tolerance_m:g}",
            k=f"{self.coverage_factor:g}",
            **places,
        )
        return state, said


@dataclass(frozen=True)
class Picture:
    """A figure of a sheet."""

    name: str
    """Of its ids, unique on the sheet."""
    title: str
    good: str
    """A sentence that says what good looks like."""
    description: str
    """What is seen, for those who do not see it."""
    draw: Callable[[], Figure]
    """Called in the house's style."""
    data: dict[str, Any] | None = None
    """Table of what is drawn (`numbers.table`)."""


@dataclass(frozen=True)
class Part:
    """One section: sentences, tables with their captions, figures."""

    heading: str
    sentences: Sequence[str] = ()
    tables: Sequence[tuple[str, dict[str, Any]]] = ()
    pictures: Sequence[Picture] = ()


@dataclass(frozen=True)
class Sheet:
    """What is on the page."""

    title: str
    subject: str
    """What it is about: a camera, a machine, a site."""
    state: str
    """GOOD, POOR or OPEN."""
    sentence: str
    """Whether it is good enough, in one line, in millimetres at the cutting edge."""
    numbers: Sequence[tuple[str, Number, str]] = ()
    """Label, number, note; six at most."""
    remarks: Sequence[str] = ()
    """What needs attention."""
    parts: Sequence[Part] = ()
    origin: Mapping[str, str] = field(default_factory=dict)
    """What it was made from: label -> text; files with their hashes, dates of recordings. No paths, no day of making:
    the same input gives the same bytes."""
    stamp: str = ""
    """The sentence's shortest form; left out, "Good enough" and the like, by the state."""


def render_sheet(sheet: Sheet, language: str = "en") -> tuple[str, dict[str, Any]]:
    """The HTML of a sheet, and the dict of everything printed on it."""
    words = Words(language)
    figures: dict[str, dict[str, str]] = {}
    svg: dict[str, str] = {}
    parts = []
    with house_style():
        for number, part in enumerate(sheet.parts):
            shown = []
            for picture in part.pictures:
                assert picture.name not in figures, picture.name
                figures[picture.name] = {
                    "title": picture.title,
                    "good": picture.good,
                    "description": picture.description,
                    "why": "",
                }
                svg[picture.name] = svg_of(
                    picture.draw(), f"figure-{picture.name}", picture.title, picture.description
                )
                shown.append({"name": picture.name, "data": picture.data})
            tables = [
                {"key": f"part{number}.{k}", "caption": caption, "table": rows}
                for k, (caption, rows) in enumerate(part.tables)
            ]
            parts.append(
                {
                    "heading": part.heading,
                    "sentences": list(part.sentences),
                    "tables": tables,
                    "pictures": shown,
                }
            )
    content: dict[str, Any] = {
        "format": FORMAT,
        "language": language,
        "version": __version__,
        "title": sheet.title,
        "subject": sheet.subject,
        "state": sheet.state,
        "word": sheet.stamp or words(f"sheet.{sheet.state}"),
        "symbol": {GOOD: "✓", POOR: "✗", OPEN: "?"}[sheet.state],
        "style": {GOOD: "pass", POOR: "fail", OPEN: "cannot-tell"}[sheet.state],
        "sentence": sheet.sentence,
        "numbers": [{"label": a, "number": b, "note": c} for a, b, c in sheet.numbers],
        "remarks": list(sheet.remarks),
        "parts": parts,
        "figures": figures,
        "origin": table(
            [column("what", words("sheet.what")), column("text", words("sheet.text"), kind="code")],
            [{"what": what, "text": text} for what, text in sheet.origin.items()],
        ),
    }
    return printed("sheet.html", content, svg, words), content
