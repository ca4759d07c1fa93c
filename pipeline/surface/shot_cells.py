"""Lines of a surveyor's text file -> cells, what each column is, and what stands in a cell.

Between the columns stand tabs, semicolons, commas, or, where every line can be read in one way only, blanks. What a
column is comes from a line of headings, or from the order that site.toml states.
"""

from __future__ import annotations

import csv
import datetime
import io
import re
import zoneinfo
from collections.abc import Iterator
from dataclasses import dataclass

from pipeline.errors import SurfaceError

KINDS = ("floor", "edge", "control")
EDGE_POINTS = ("left", "middle", "right")
HEADINGS = {
    "point": "point", "point id": "point", "point_id": "point", "pointid": "point", "id": "point", "name": "point",
    "p": "point", "pt": "point", "no": "point", "number": "point",
    "n": "northing", "north": "northing", "northing": "northing",
    "e": "easting", "east": "easting", "easting": "easting",
    "z": "elevation", "h": "elevation", "elev": "elevation", "elevation": "elevation", "height": "elevation",
    "code": "code", "d": "code", "desc": "code", "description": "code",
    "time": "time", "kind": "kind", "edge_point": "edge_point", "sigma_mm": "sigma_mm",
}  # fmt: skip
"""Headings in small letters -> what the column is. x and y are northing and easting to some and the reverse to others:
they name nothing."""
ORDERS = {
    "PNEZD": ("point", "northing", "easting", "elevation", "code"),
    "PENZD": ("point", "easting", "northing", "elevation", "code"),
}
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_WORD = r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)"
_ALIGNED = re.compile(rf"\s*(\S+)\s+({_WORD})\s+({_WORD})\s+({_WORD})(?:\s+(?!\s|{_WORD}(?:\s|$))(.*))?\s*")
"""A fourth number would leave open whether the name has a blank in it."""
_PLAIN_HEADINGS = {*HEADINGS, "x", "y"}
_TIME = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d{1,9})?)?\s*(Z|[+-]\d\d(:?\d\d)?)?", re.IGNORECASE
)
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)


@dataclass(frozen=True)
class Row:
    """One line of the file, cut into cells."""

    where: str
    """File and line, for messages."""
    line: int
    cells: list[str]


@dataclass(frozen=True)
class Layout:
    """What stands where in a line."""

    columns: dict[str, int]
    """Meaning -> place; all of point, northing, easting and elevation are there."""
    code_to_end: bool
    """A description that may hold the separator runs to the end of the line."""


def rows_of(text: str, source: str) -> tuple[str, list[str] | None, Iterator[Row]]:
    """The separator (a blank for aligned columns), the headings if there are any, and the lines of shots.

    Raises
    ------
    SurfaceError
        The lines are not those of a table of shots, or the CSV is broken.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    # The separator is what most lines have at least three of; tabs and semicolons never stand inside a number.
    separator = next((s for s in "\t;," if sum(line.count(s) >= 3 for line in lines) > len(lines) / 2), None)
    if separator in (None, ",") and _is_aligned(lines):
        separator = " "
    if separator is None:
        raise SurfaceError(
            f"{source}: no lines of point, two coordinates, elevation and description separated by commas, "
            f"semicolons or tabs, or by blanks that can be read in one way only; the first one is '{lines[0][:60]}'"
        )
    # Where a line ends in a description that is all; with other columns behind it each cell must be one word.
    titles = lines[0].split() if separator == " " and _titles(lines[0]) else []
    words = (
        len(titles) if len(titles) > 5 or (titles[4:] and HEADINGS.get(titles[4].lower()) != "code") else 0
    )
    rows = _aligned(text, source, words) if separator == " " else _separated(text, separator, source)
    first = next(rows, None)
    if first is None:
        return separator, None, iter(())
    # Among the first cells, as a description may be any word.
    if any(cell.lower() in _PLAIN_HEADINGS for cell in first.cells[1:4]):
        return separator, [cell.lower() for cell in first.cells], rows
    return separator, None, _chain(first, rows)


def layout_of(headings: list[str] | None, order: str, source: str) -> Layout:
    """What each column is, by the headings and the order that site.toml states.

    Raises
    ------
    SurfaceError
        The two contradict each other, or with `named` there are no headings, or some are missing or double.
    """
    found: dict[str, int] = {}
    for place, heading in enumerate(headings or ()):
        meaning = HEADINGS.get(heading)
        if meaning in found:
            raise SurfaceError(
                f"{source}: two columns are headed as {meaning} ('{heading}' is the second); rename one"
            )
        if meaning is not None:
            found[meaning] = place
    if order == "named":
        if missing := [m for m in ("point", "easting", "northing", "elevation") if m not in found]:
            raise SurfaceError(
                f"{source}: site.toml says checks.order = 'named', but no column is headed {' or '.join(missing)}; "
                "write such headings in the first line, or the order PNEZD or PENZD in site.toml"
            )
        return Layout(found, found.get("code") == len(headings or ()) - 1)
    stated = ORDERS[order]
    places = {meaning: place for place, meaning in enumerate(stated)}
    if headings is None:
        return Layout(places, True)
    if all(m in found for m in stated[:4]) and any(found[m] != places[m] for m in stated[:4]):
        shown = ", ".join(headings[:4])
        other = next((o for o, m in ORDERS.items() if all(found[c] == m.index(c) for c in m[:4])), "named")
        raise SurfaceError(
            f"{source}: its headings are {shown}, but site.toml says checks.order = '{order}'; write '{other}'"
        )
    # Columns after the elevation may have any order, if they are named.
    more = {m: place for m, place in found.items() if place >= 4}
    if not {"time", "kind", "edge_point", "sigma_mm"} & set(more):
        return Layout(places, True)
    code = {"code": more["code"]} if "code" in more else {}
    more.pop("code", None)
    return Layout(
        {m: places[m] for m in stated[:4]} | more | code, bool(code) and code["code"] == len(headings) - 1
    )


MOST = 1e9
"""No grid has larger coordinates, in whatever unit."""


def number(cell: str, separator: str, where: str) -> float:
    """The number in a cell; a decimal comma is understood where the separator is not a comma. Raises SurfaceError."""
    if separator != "," and _DECIMAL_COMMA.fullmatch(cell):
        cell = cell.replace(",", ".")
    if not _NUMBER.fullmatch(cell) or not abs(float(cell)) <= MOST:
        raise SurfaceError(f"{where}: expected a number, found '{cell[:40]}'")
    return float(cell)


def with_separator(cells: list[str]) -> list[str] | None:
    """The cells of a line like ``FS968 B 989.18 | 996.05 | 99.93 |`` with its name and first number parted, or None.

    Total stations write such lines where a name fills its field. Only one reading of them makes three numbers.
    """
    name, _, first = cells[0].rpartition(" ")
    numbers = [bool(_NUMBER.fullmatch(cell)) for cell in cells[1:4]]
    if name and _NUMBER.fullmatch(first) and numbers[:2] == [True, True] and numbers[2:] != [True]:
        return [name.strip(), first, *cells[1:]]
    return None


def time_ns(cell: str, zone: str, where: str) -> int:
    """Nanoseconds UTC of a time in ISO 8601.

    Parameters
    ----------
    cell : str
        Date and time of day, with its offset from UTC or, if `zone` says which clock, without.
    zone : str
        Name in the IANA database, or nothing.
    where : str
        For the message.

    Raises
    ------
    SurfaceError
        It is no such time, or could be two instants, or is none.
    """
    text = cell.strip()
    if not _TIME.fullmatch(text):
        raise SurfaceError(
            f"{where}: expected a date and time such as 2026-05-04T10:42:31Z, found '{cell[:40]}'"
        )
    whole, _, fraction = text.replace(",", ".").partition(".")
    digits = re.match(r"\d*", fraction)
    kept = digits.group() if digits else ""
    try:
        when = datetime.datetime.fromisoformat(whole + fraction[len(kept) :].strip().upper())
    except ValueError as error:
        raise SurfaceError(f"{where}: '{cell[:40]}' is no date and time ({error})") from None
    if when.tzinfo is None:
        when = _local(when, zone, cell, where)
    if not 1970 < when.year < 2200:  # tables have nanoseconds in 64 bits
        raise SurfaceError(f"{where}: '{cell[:40]}' is no time of a log: check the year")
    since = when - _EPOCH
    return (since.days * 86_400 + since.seconds) * 10**9 + int(kept.ljust(9, "0") or 0)


def _local(when: datetime.datetime, zone: str, cell: str, where: str) -> datetime.datetime:
    if not zone:
        raise SurfaceError(
            f"{where}: the time '{cell[:40]}' does not say which clock: write its offset from UTC, such as "
            f"{when.isoformat()}Z, or give report.time_zone in site.toml"
        )
    try:
        place = zoneinfo.ZoneInfo(zone)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        raise SurfaceError(
            f"{where}: report.time_zone = '{zone}' of site.toml is not in the database of time zones; "
            "write a name such as Europe/Helsinki"
        ) from None
    early, late = when.replace(tzinfo=place, fold=0), when.replace(tzinfo=place, fold=1)
    if early.utcoffset() == late.utcoffset():
        return early
    again = early.astimezone(datetime.UTC).astimezone(place).replace(tzinfo=None)
    what = "is twice on the clocks of" if again == when else "is skipped by the clocks of"
    raise SurfaceError(f"{where}: the time '{cell[:40]}' {what} {zone}; write its offset from UTC")


def _separated(text: str, separator: str, source: str) -> Iterator[Row]:
    rows = csv.reader(io.StringIO(text), delimiter=separator)
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield Row(f"{source}:{rows.line_num}", rows.line_num, cells)
    except csv.Error as error:
        raise SurfaceError(f"{source}:{rows.line_num}: not readable as CSV ({error})") from None


def _is_aligned(lines: list[str]) -> bool:
    """Whether each line, but for a heading, is a name without blanks, three numbers and perhaps more."""
    body = lines[1:] if lines and not _ALIGNED.fullmatch(lines[0]) and _titles(lines[0]) else lines
    return bool(body) and all(len(line) < 1000 and _ALIGNED.fullmatch(line) for line in body)


def _titles(line: str) -> bool:
    return any(word.lower() in _PLAIN_HEADINGS for word in line.split()[1:4])


def _aligned(text: str, source: str, words: int) -> Iterator[Row]:
    for line_number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        found = None if words else _ALIGNED.fullmatch(line)
        if words and len(line.split()) != words:
            raise SurfaceError(
                f"{source}:{line_number}: {words} columns are headed, and between blanks stand {len(line.split())} "
                "words; export the shots with commas, semicolons or tabs between the columns"
            )
        cells = line.split() if found is None else [cell for cell in found.groups() if cell is not None]
        yield Row(f"{source}:{line_number}", line_number, [cell.strip() for cell in cells])


def _chain(first: Row, rest: Iterator[Row]) -> Iterator[Row]:
    yield first
    yield from rest
