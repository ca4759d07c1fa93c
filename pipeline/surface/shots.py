"""Total-station shots from a text file: point, two coordinates in a stated order, elevation, description.

PNEZD and PENZD cannot be told apart by their form, so the order is stated in site.toml and checked against where
the design is. Ids are strings: `007` is not 7 and `NA` is a name.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import SurfaceError

MAX_SHOTS = 1_000_000
NEAR_M = 100.0
"""A shot this far outside the design's box still belongs to the job: control points, for example."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_HEADINGS = {
    "n",
    "north",
    "northing",
    "e",
    "east",
    "easting",
    "z",
    "elev",
    "elevation",
    "height",
    "y",
    "x",
    "h",
}


@dataclass(frozen=True)
class Shots:
    """Total-station shots, in the order of the file."""

    point: np.ndarray
    """(n,) ids, strings."""
    code: np.ndarray
    """(n,) descriptions, strings, empty where the file has none."""
    p_grid: np.ndarray
    """(n, 3) easting, northing, elevation; grid metres."""
    mended: tuple[int, ...] = ()
    """Lines of the file in which the separator after the point's name was missing and was put back."""

    def __len__(self) -> int:
        return len(self.point)


def read_shots(path: Path, order: str, metres_per_unit: float) -> Shots:
    """Shots of a text file separated by commas, semicolons or tabs, with or without a line of headings.

    Parameters
    ----------
    path : Path
        UTF-8 (Latin-1 is understood); a decimal comma is understood where the separator is not a comma.
    order : str
        `PNEZD` (northing first) or `PENZD` (easting first).
    metres_per_unit : float
        Of the grid.

    Returns
    -------
    Shots
        Possibly none.

    Raises
    ------
    SurfaceError
        Names file and line.
    """
    assert order in ("PNEZD", "PENZD"), order
    text = _text(path)
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        return Shots(np.zeros(0, object), np.zeros(0, object), np.zeros((0, 3)))
    # The separator is what most lines have at least three of; tabs and semicolons never stand inside a number.
    separator = next(
        (s for s in "\t;," if sum(line.count(s) >= 3 for line in lines) > len(lines) / 2),
        None,
    )
    if separator is None:
        raise SurfaceError(
            f"{path.name}: no lines of point, two coordinates, elevation and description separated by commas, "
            f"semicolons or tabs; the first one is '{lines[0][:60]}'"
        )
    rows = csv.reader(io.StringIO(text), delimiter=separator)
    point, code, coordinates = [], [], []
    mended: list[int] = []
    heading = True
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if heading and any(cell.lower() in _HEADINGS for cell in cells[1:4]):
                heading = False
                _check_heading(cells, order, path.name)
                continue
            heading = False
            where = f"{path.name}:{rows.line_num}"
            if whole := _with_separator(cells):
                cells = whole
                mended.append(rows.line_num)
            if len(cells) < 4:
                raise SurfaceError(
                    f"{where}: expected point, two coordinates and elevation, found {len(cells)} columns"
                )
            first, second, elevation = (_number(cell, separator, where) for cell in cells[1:4])
            point.append(cells[0])
            code.append(separator.join(cells[4:]).strip(separator + " "))
            coordinates.append((second, first, elevation) if order == "PNEZD" else (first, second, elevation))
            if len(point) > MAX_SHOTS:
                raise SurfaceError(f"{path.name}: more than {MAX_SHOTS} shots; cut the file down to the job")
    except csv.Error as error:
        raise SurfaceError(f"{path.name}:{rows.line_num}: not readable as CSV ({error})") from None
    p_grid = np.array(coordinates, dtype=np.float64).reshape(-1, 3) * metres_per_unit
    return Shots(np.array(point, dtype=object), np.array(code, dtype=object), p_grid, tuple(mended))


def check_order(shots: Shots, low_en: np.ndarray, high_en: np.ndarray, order: str, source: str) -> None:
    """Raise SurfaceError where the shots lie on the design only with northing and easting exchanged.

    Parameters
    ----------
    shots : Shots
        In the order that was stated.
    low_en, high_en : (2,) arrays
        Box of the design, grid metres.
    order : str
        As stated.
    source : str
        The file, for the message.
    """
    if not len(shots):
        return
    en = shots.p_grid[:, :2]
    as_stated, exchanged = (
        int(np.count_nonzero(np.all((q >= low_en - NEAR_M) & (q <= high_en + NEAR_M), axis=1)))
        for q in (en, en[:, ::-1])
    )
    if as_stated < 0.5 * len(shots) and exchanged > max(0.5 * len(shots), as_stated):
        other = "PENZD" if order == "PNEZD" else "PNEZD"
        raise SurfaceError(
            f"{source}: read as {order}, {as_stated} of {len(shots)} shots lie near the design; with northing and "
            f"easting exchanged {exchanged} do. Write checks.order = '{other}' in site.toml"
        )


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise SurfaceError(f"{path.name}: no such file beside site.toml; put the check shots there") from None
    except OSError as error:
        raise SurfaceError(f"{path.name}: cannot be read ({error.strerror})") from None
    if b"\0" in data:
        raise SurfaceError(f"{path.name}: is not a text file; export the shots as CSV")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _check_heading(cells: list[str], order: str, source: str) -> None:
    """Headings that say the opposite of site.toml are an error; others are passed over."""
    first, second = cells[1].lower(), cells[2].lower()
    if (order == "PNEZD" and first.startswith("e") and second.startswith("n")) or (
        order == "PENZD" and first.startswith("n") and second.startswith("e")
    ):
        other = "PENZD" if order == "PNEZD" else "PNEZD"
        raise SurfaceError(
            f"{source}: its headings are {', '.join(cells[:4])}, but site.toml says checks.order = '{order}'; "
            f"write '{other}'"
        )


def _with_separator(cells: list[str]) -> list[str] | None:
    """The cells of a line like ``FS968 B 989.18 | 996.05 | 99.93 |`` with its name and first number parted, or None.

    Total stations write such lines where a name fills its field. Only one reading of them makes three numbers.
    """
    name, _, number = cells[0].rpartition(" ")
    numbers = [bool(_NUMBER.fullmatch(cell)) for cell in cells[1:4]]
    if name and _NUMBER.fullmatch(number) and numbers[:2] == [True, True] and numbers[2:] != [True]:
        return [name.strip(), number, *cells[1:]]
    return None


def _number(cell: str, separator: str, where: str) -> float:
    if separator != "," and _DECIMAL_COMMA.fullmatch(cell):
        cell = cell.replace(",", ".")
    if not _NUMBER.fullmatch(cell):
        raise SurfaceError(f"{where}: expected a number, found '{cell[:40]}'")
    return float(cell)
