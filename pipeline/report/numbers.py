"""Numbers and tables as they go to the page and, the very same objects, to report.json.

A number is a dict ``{value, unit, digits, signed}`` in the unit it is printed in; a table is
``{columns, rows}`` with its units and digits on the columns. Templates only print them, and the tests
read the page back and compare with report.json.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

Number = dict[str, Any]
Rows = list[dict[str, Any]]
SPARE_DIGITS = 3
"""report.json keeps this many digits more than the page prints."""


def number(value: Any, unit: str = "", digits: int = 0, signed: bool = False) -> Number:
    """A number for the page, already in its printed unit; None or NaN is printed as a dash."""
    return {"value": plain(value, digits), "unit": unit, "digits": digits, "signed": signed}


def plain(value: Any, digits: int) -> float | int | None:
    """A JSON number: rounded to a few digits more than are printed, None for NaN, int for digits 0 counts."""
    if value is None:
        return None
    if isinstance(value, (int, np.integer)):
        return int(value)
    value = float(value)
    if not np.isfinite(value):
        return None
    return round(value, digits + SPARE_DIGITS) + 0.0


def column(
    key: str, label: str, unit: str = "", digits: int | None = None, signed: bool = False, kind: str = ""
) -> dict[str, Any]:
    """One column of a table. `digits` None means text; `kind` names its class: judged, code, id or why."""
    return {"key": key, "label": label, "unit": unit, "digits": digits, "signed": signed, "kind": kind}


def table(columns: Sequence[dict[str, Any]], rows: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """A table of the page; values of numeric columns are made plain."""
    ready: Rows = []
    for row in rows:
        shown: dict[str, Any] = {}
        for col in columns:
            value = row.get(col["key"])
            if col["digits"] is not None:
                shown[col["key"]] = plain(value, col["digits"])
            else:
                shown[col["key"]] = "" if value is None else str(value)
        ready.append(shown)
    return {"columns": list(columns), "rows": ready}


def records(columns: Mapping[str, Any]) -> Rows:
    """Equal-length columns -> rows."""
    names = list(columns)
    return [dict(zip(names, values)) for values in zip(*(columns[name] for name in names))]


def utc_text(time_ns: int, fraction: int = 0) -> str:
    """``2026-11-22 07:10:31 UTC``."""
    return _clock(time_ns, fraction, datetime.UTC).strip() + " UTC"


def local_text(time_ns: int, zone: str, fraction: int = 0) -> str | None:
    """The same instant on the site's clock with its name, or None where the zone is not known here."""
    try:
        place = ZoneInfo(zone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None
    moment = datetime.datetime.fromtimestamp(int(time_ns) // 10**9, place)
    return f"{_clock(time_ns, fraction, place)} {moment.tzname()}"


def _clock(time_ns: int, fraction: int, zone: datetime.tzinfo) -> str:
    seconds, rest = divmod(int(time_ns), 10**9)
    shown = datetime.datetime.fromtimestamp(seconds, zone).strftime("%Y-%m-%d %H:%M:%S")
    return f"{shown}.{rest // 10 ** (9 - fraction):0{fraction}d}" if fraction else shown


def duration_text(seconds: float) -> str:
    """``1 h 02 min 03 s``, ``2 min 30 s`` or ``12.4 s``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    hours, minutes, left = whole // 3600, whole % 3600 // 60, whole % 60
    return f"{hours} h {minutes:02d} min {left:02d} s" if hours else f"{minutes} min {left:02d} s"
