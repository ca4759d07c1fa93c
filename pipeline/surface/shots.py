"""Total-station shots from a text file: point, two coordinates in a stated order, elevation, description, and more.

PNEZD and PENZD cannot be told apart by their form, so the order is stated in site.toml and checked against where
the design is; a file with headings may have its columns in any order. Ids are strings: `007` is not 7 and `NA` is a
name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface import shot_cells
from pipeline.surface.shot_cells import EDGE_POINTS, KINDS, ORDERS, Layout, Row

MAX_SHOTS = 1_000_000
NEAR_M = 100.0
"""A shot this far outside the design's box still belongs to the job: control points, for example."""
NO_TIME = int(np.iinfo(np.int64).min)
"""Where a shot has no time: null of an integer column."""
_NONE = np.zeros(0)


@dataclass(frozen=True)
class Shots:
    """Total-station shots, in the order of the file. What is left out is floor, without time or a sigma of its own."""

    point: np.ndarray
    """(n,) ids, strings."""
    code: np.ndarray
    """(n,) descriptions, strings, empty where the file has none."""
    p_grid: np.ndarray
    """(n, 3) easting, northing, elevation; grid metres."""
    mended: tuple[int, ...] = ()
    """Lines of the file in which the separator after the point's name was missing and was put back."""
    kind: np.ndarray = field(default_factory=lambda: _NONE)
    """(n,) floor, edge or control."""
    time_ns: np.ndarray = field(default_factory=lambda: _NONE)
    """(n,) int64 UTC, or NO_TIME."""
    edge_point: np.ndarray = field(default_factory=lambda: _NONE)
    """(n,) left, middle or right; empty where the file does not say."""
    sigma_m: np.ndarray = field(default_factory=lambda: _NONE)
    """(n,) standard deviation that the file gives, nan where it gives none."""

    def __post_init__(self) -> None:
        n = len(self.point)
        whole = {
            "kind": np.full(n, "floor", object),
            "time_ns": np.full(n, NO_TIME, np.int64),
            "edge_point": np.full(n, "", object),
            "sigma_m": np.full(n, np.nan),
        }
        for name, value in whole.items():
            if getattr(self, name) is _NONE:
                object.__setattr__(self, name, value)
            assert len(getattr(self, name)) == n, name

    def __len__(self) -> int:
        return len(self.point)

    def take(self, rows: np.ndarray) -> Shots:
        """Some of them, by index or mask."""
        columns = ("point", "code", "p_grid", "kind", "time_ns", "edge_point", "sigma_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def read_shots(
    path: Path,
    order: str,
    metres_per_unit: float,
    zone: str = "",
    kind_of_code: Mapping[str, str] | None = None,
) -> Shots:
    """Shots of a text file separated by commas, semicolons, tabs or blanks, with or without a line of headings.

    Parameters
    ----------
    path : Path
        UTF-8 (Latin-1 is understood); a decimal comma is understood where the separator is not a comma.
    order : str
        `PNEZD` (northing first), `PENZD` (easting first), or `named`: as the headings say.
    metres_per_unit : float
        Of the grid.
    zone : str
        IANA name of the clock of times without an offset from UTC.
    kind_of_code : mapping, optional
        First word of a description -> kind of shot, for files without a column of kinds.

    Returns
    -------
    Shots
        Possibly none.

    Raises
    ------
    SurfaceError
        Names file and line.
    """
    assert order == "named" or order in ORDERS, order
    text = _text(path)
    if not text.strip():
        return Shots(np.zeros(0, object), np.zeros(0, object), np.zeros((0, 3)))
    separator, headings, rows = shot_cells.rows_of(text, path.name)
    layout = shot_cells.layout_of(headings, order, path.name)
    reader = _Reader(layout, separator, zone, kind_of_code or {})
    for row in rows:
        reader.add(row)
        if len(reader.point) > MAX_SHOTS:
            raise SurfaceError(f"{path.name}: more than {MAX_SHOTS} shots; cut the file down to the job")
    return reader.shots(metres_per_unit)


def order_of(file: Path, order: str) -> str:
    """A file with headings says itself what its columns are."""
    try:
        first = file.read_text(encoding="utf-8", errors="replace").lstrip("\ufeff").splitlines()[:1]
    except OSError:
        return order
    words = {word.strip().lower() for word in first[0].replace(";", ",").split(",")} if first else set()
    return "named" if {"northing", "easting"} <= words else order


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
        remedy = (
            "The headings northing and easting are exchanged"
            if order == "named"
            else f"Write checks.order = '{'PENZD' if order == 'PNEZD' else 'PNEZD'}' in site.toml"
        )
        raise SurfaceError(
            f"{source}: read as {order}, {as_stated} of {len(shots)} shots lie near the design; with northing and "
            f"easting exchanged {exchanged} do. {remedy}"
        )


class _Reader:
    """The columns of the shots, row by row."""

    def __init__(self, layout: Layout, separator: str, zone: str, kind_of_code: Mapping[str, str]):
        self.layout, self.separator, self.zone, self.kind_of_code = layout, separator, zone, kind_of_code
        self.point: list[str] = []
        self.code: list[str] = []
        self.enh: list[tuple[float, float, float]] = []
        self.kind: list[str] = []
        self.time_ns: list[int] = []
        self.edge_point: list[str] = []
        self.sigma_m: list[float] = []
        self.mended: list[int] = []
        self.least = 1 + max(layout.columns[name] for name in ("point", "northing", "easting", "elevation"))

    def add(self, row: Row) -> None:
        cells = row.cells
        if whole := shot_cells.with_separator(cells):
            cells = whole
            self.mended.append(row.line)
        if len(cells) < self.least:
            raise SurfaceError(
                f"{row.where}: expected point, two coordinates and elevation, found {len(cells)} columns"
            )
        columns = self.layout.columns
        easting, northing, elevation = (
            shot_cells.number(cells[columns[name]], self.separator, row.where)
            for name in ("easting", "northing", "elevation")
        )
        code = self._cell(cells, "code")
        if self.layout.code_to_end and "code" in columns:
            code = self.separator.join(cells[columns["code"] :]).strip(self.separator + " ")
        time, kind = self._cell(cells, "time"), self._cell(cells, "kind").lower()
        sigma, edge_point = self._cell(cells, "sigma_mm"), self._cell(cells, "edge_point").lower()
        if kind and kind not in KINDS:
            raise SurfaceError(f"{row.where}: kind '{kind[:40]}' is none of {', '.join(KINDS)}")
        if edge_point and edge_point not in EDGE_POINTS:
            raise SurfaceError(
                f"{row.where}: edge_point '{edge_point[:40]}' is none of {', '.join(EDGE_POINTS)}"
            )
        sigma_m = shot_cells.number(sigma, self.separator, row.where) / 1000 if sigma else np.nan
        if sigma_m <= 0:
            raise SurfaceError(
                f"{row.where}: sigma_mm {sigma} is not above zero; leave the cell empty if unknown"
            )
        words = code.lower().split()
        self.point.append(cells[columns["point"]])
        self.code.append(code)
        self.enh.append((easting, northing, elevation))
        self.kind.append(kind or self.kind_of_code.get(code.split()[0] if words else "", "floor"))
        self.time_ns.append(shot_cells.time_ns(time, self.zone, row.where) if time else NO_TIME)
        told = [name for name in EDGE_POINTS if name in words]
        self.edge_point.append(edge_point or (told[0] if len(told) == 1 else ""))
        self.sigma_m.append(sigma_m)

    def _cell(self, cells: list[str], name: str) -> str:
        place = self.layout.columns.get(name)
        return "" if place is None or place >= len(cells) else cells[place]

    def shots(self, metres_per_unit: float) -> Shots:
        words = {
            name: np.array(getattr(self, name), object) for name in ("point", "code", "kind", "edge_point")
        }
        return Shots(
            p_grid=np.array(self.enh, dtype=np.float64).reshape(-1, 3) * metres_per_unit,
            mended=tuple(self.mended),
            time_ns=np.array(self.time_ns, np.int64),
            sigma_m=np.array(self.sigma_m, np.float64),
            **words,
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
