"""Tables of the page as CSV, for those who take the numbers further."""

from __future__ import annotations

import csv
import io
from typing import Any

FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def csv_of(table: dict[str, Any], heading: bool = True) -> bytes:
    """A table of the page as CSV with its units in the header: full precision, empty where there is no value.

    The `heading` is left out where programs that import such a file would take it for a point. Text that a
    spreadsheet would run as a formula is quoted with an apostrophe: point ids come from files that others wrote.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = table["columns"]
    if heading:
        writer.writerow([f"{c['key']} [{c['unit']}]" if c["unit"] else c["key"] for c in columns])
    for row in table["rows"]:
        writer.writerow([_text(row[c["key"]], numeric=c["digits"] is not None) for c in columns])
    return out.getvalue().encode("utf-8")


def _text(value: Any, numeric: bool) -> str:
    if value is None:
        return ""
    if numeric:
        return repr(value)
    text = str(value)
    return "'" + text if text.startswith(FORMULA_STARTS) else text
