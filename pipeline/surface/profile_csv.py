"""A trench by station from a CSV file: floor, width and side slope, whatever the separator and the decimal mark."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np

from pipeline.errors import SurfaceError

PROFILE_COLUMNS = ("station", "elevation", "width", "side_slope")
MAX_PROFILE_ROWS = 1_000_000
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


def read_profile_rows(path: Path) -> np.ndarray:
    """(n, 4) of the columns station, elevation, width, side_slope, as written; further columns are passed over.

    Raises
    ------
    SurfaceError
        Names file, line and column.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SurfaceError(f"{path.name}: no such file beside site.toml; put the design there") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SurfaceError(f"{path.name}: cannot be read as UTF-8 text ({error})") from None
    header = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = max(",;\t", key=header.count)
    rows = csv.reader(io.StringIO(text), delimiter=delimiter)
    names: list[str] | None = None
    values: list[list[float]] = []
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if names is None:
                names = [cell.lower() for cell in cells]
                missing = [name for name in PROFILE_COLUMNS if name not in names]
                if missing:
                    raise SurfaceError(
                        f"{path.name}:{rows.line_num}: the first line must name the columns "
                        f"{', '.join(PROFILE_COLUMNS)}; missing: {', '.join(missing)}"
                    )
                continue
            values.append(_profile_row(cells, names, delimiter, f"{path.name}:{rows.line_num}"))
            if len(values) > MAX_PROFILE_ROWS:
                raise SurfaceError(f"{path.name}: more than {MAX_PROFILE_ROWS} rows; thin the profile out")
    except csv.Error as error:
        raise SurfaceError(f"{path.name}:{rows.line_num}: not readable as CSV ({error})") from None
    if len(values) < 2:
        raise SurfaceError(
            f"{path.name}: holds {len(values)} rows of the design; at least two stations are needed"
        )
    table = np.array(values)
    bad = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(bad):
        raise SurfaceError(
            f"{path.name}: stations must grow from row to row; {table[bad[0] + 1, 0]:g} follows {table[bad[0], 0]:g}"
        )
    if np.any(table[:, 2] <= 0) or np.any(table[:, 3] < 0):
        raise SurfaceError(f"{path.name}: width must be positive and side_slope must not be negative")
    return table


def _profile_row(cells: list[str], names: list[str], delimiter: str, where: str) -> list[float]:
    # Decimal commas between commas make more cells than there are columns, and every one would be a sound number.
    if any(cells[len(names) :]):
        raise SurfaceError(
            f"{where}: has {len(cells)} cells for {len(names)} columns; if the file has decimal commas, separate the "
            "columns with semicolons"
        )
    numbers = []
    for name in PROFILE_COLUMNS:
        column = names.index(name)
        text = cells[column] if column < len(cells) else ""
        if delimiter != "," and _DECIMAL_COMMA.fullmatch(text):
            text = text.replace(",", ".")
        try:
            number = float(text)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise SurfaceError(f"{where}: {name}: expected a number, found '{text}'")
        numbers.append(number)
    return numbers
