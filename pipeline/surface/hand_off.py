"""What leaves the house as a drawing: the as-built surface as triangles, points of the floor, the long profile.

* **Surface**: corners are the centres of cells that were cut and hang together, side by side, with the cut floor, at
  their own elevations; faces join only cells that lie side by side. A cell that was not cut leaves a hole, and no
  face reaches across it. Where that would make more than `MAX_FACES` faces only every k-th row of cells along the
  alignment and the last one keep their corners (of wide surfaces every so many columns too), and a face stands only
  where every cell that it covers was cut: thinning can make a gap wider and never narrower.
* **Points**: three per station that was reached, on the floor as it was cut: its left edge, its middle, its right edge.
* **Profile**: the mean floor of the stations that were reached, in stretches without a gap.

Everything is in grid metres; the writers turn it into the unit of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label

from pipeline.surface.alignment import Alignment

MAX_FACES = 40_000
"""A drawing of this many faces has 8 MB; those who want every cell have as_built.parquet."""
DECIMALS = 6
"""Digits after the point in every file that leaves: a micrometre, as in report.json."""
LEFT, CENTRE, RIGHT = "L", "C", "R"


@dataclass(frozen=True)
class CutCells:
    """The cells of the as-built surface that were cut; arrays (n,), metres."""

    station: np.ndarray
    offset: np.ndarray
    h: np.ndarray
    floor: np.ndarray
    """bool: on the designed floor."""
    cell_m: float

    def __len__(self) -> int:
        return len(self.station)


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles."""

    points: np.ndarray
    """(n, 3) easting, northing, elevation, grid metres."""
    faces: np.ndarray
    """(m, 3) int, counter-clockwise as seen from above."""
    every: int = 1
    """One row of cells along the alignment in so many has corners; 1 where nothing was thinned."""
    across: int = 1
    """The same for columns of cells."""

    def areas(self, scale: float = 1.0) -> tuple[float, float]:
        """Area in plan and area on the slope, in squares of a unit of `scale` metres."""
        corners = self.points[self.faces] / scale
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return 0.5 * float(np.abs(normal[:, 2]).sum()), 0.5 * float(np.linalg.norm(normal, axis=1).sum())


@dataclass(frozen=True)
class FloorPoints:
    """Points of the as-built floor with their names; arrays (n,)."""

    name: np.ndarray
    """`S`, the station in the unit of the grid, and L, C or R."""
    code: np.ndarray
    p_grid: np.ndarray
    """(n, 3) easting, northing, elevation, grid metres."""


@dataclass(frozen=True)
class Marks:
    """Points of a drawing with a line of text each."""

    p_grid: np.ndarray
    """(n, 3) easting, northing, elevation, grid metres."""
    text: tuple[str, ...]


@dataclass(frozen=True)
class HandOff:
    """Everything that the drawings of a run hold."""

    unit: str
    """Of the grid, as site.toml spells it: the unit of the files."""
    metres_per_unit: float
    project: str
    version: str
    """Of this program."""
    recorded_ns: int
    """End of the log, UTC: the files carry the date of what they show, so that they repeat byte by byte."""
    alignment: Alignment
    surface: Mesh
    profile: tuple[np.ndarray, ...] = ()
    """Stretches (k, 2) of station and elevation, metres."""
    stations: Marks | None = None
    checks: Marks | None = None
    surface_name: str = "as-built"


def mesh_of_cells(cells: CutCells, alignment: Alignment, max_faces: int = MAX_FACES) -> Mesh:
    """The cells that were cut as a surface of at most `max_faces` triangles; see the module for the rule."""
    if not len(cells):
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    row = np.round((cells.station - cells.station.min()) / cells.cell_m).astype(np.int64)
    column = np.round((cells.offset - cells.offset.min()) / cells.cell_m).astype(np.int64)
    index = np.full((row.max() + 1, column.max() + 1), -1, np.int32)
    index[row, column] = np.arange(len(cells))
    # The edge crosses the designed slopes in the air above the ground too; nothing joins such scraps to the floor.
    patch, _ = label(index >= 0)
    index[~np.isin(patch, patch[row[cells.floor], column[cells.floor]])] = -1
    # Sums from the first cell on tell of any block of cells whether all of it was cut.
    total = np.zeros((index.shape[0] + 1, index.shape[1] + 1), np.int32)
    total[1:, 1:] = np.cumsum(np.cumsum(index >= 0, axis=0, dtype=np.int32), axis=1)
    step, every, across = 1, 1, 1
    squares, kept = _whole_squares(total, every, across)
    while 2 * np.count_nonzero(squares) > max_faces:
        # Trenches are long and narrow: across they are thinned late, or their edges would suffer.
        step += 1 + step // 8
        every, across = step, max(1, step // 10)
        squares, kept = _whole_squares(total, every, across)
    faces = _faces(index[kept], squares, halves=every == across == 1)
    if len(faces) > max_faces:  # by half squares, which stand at the end
        faces = faces[: 2 * np.count_nonzero(squares)]
    used, corner = np.unique(faces, return_inverse=True)
    en = alignment.points(cells.station[used], cells.offset[used])
    return Mesh(np.column_stack([en, cells.h[used]]), corner.reshape(-1, 3).astype(np.int64), every, across)


def floor_points(
    cells: CutCells, alignment: Alignment, station: np.ndarray, reached: np.ndarray, metres_per_unit: float
) -> FloorPoints:
    """Left edge, middle and right edge of the cut floor at each station that was reached.

    A station lies as often on the border of two rows of cells as inside one. At each offset the point is the mean,
    in place and elevation, of the cut cells that touch the station there; the outermost offsets are the edges, and
    the one nearest to half-way between them is the middle. Where only one or two offsets were cut there are no more
    points than that, and none where the cut cells that a station stands for end short of it.

    Parameters
    ----------
    cells : CutCells
        Of the whole surface; those of the floor count.
    alignment : Alignment
        That they are along.
    station : (n,) array
        Metres.
    reached : (n,) bool array
        The others get no points.
    metres_per_unit : float
        Of the grid: names say the station in its unit.
    """
    order = np.argsort(cells.station[cells.floor], kind="stable")
    along, across, h = (values[cells.floor][order] for values in (cells.station, cells.offset, cells.h))
    half = cells.cell_m * (0.5 + 1e-6)
    first = np.searchsorted(along, station - half, side="left")
    last = np.searchsorted(along, station + half, side="right")
    places: list[tuple[float, float, float]] = []
    owner: list[int] = []
    side: list[str] = []
    for i in np.flatnonzero(reached):
        at = slice(first[i], last[i])
        if first[i] == last[i]:
            continue
        offset, of_cell = np.unique(np.round(across[at], 6), return_inverse=True)
        count = np.bincount(of_cell)
        mean_station = np.bincount(of_cell, along[at]) / count
        mean_h = np.bincount(of_cell, h[at]) / count
        middle = int(np.argmin(np.abs(offset - 0.5 * (offset[0] + offset[-1]))))
        chosen = {0: LEFT, len(offset) - 1: RIGHT} if len(offset) > 1 else {}
        if middle not in chosen:
            chosen[middle] = CENTRE
        for k in sorted(chosen):
            places.append((mean_station[k], offset[k], mean_h[k]))
            owner.append(int(i))
            side.append(chosen[k])
    found = np.array(places).reshape(-1, 3)
    names = _station_names(station / metres_per_unit)
    return FloorPoints(
        name=np.array([names[i] + s for i, s in zip(owner, side)], dtype=object),
        code=np.array([f"FLOOR-{s}" for s in side], dtype=object),
        p_grid=np.column_stack([alignment.points(found[:, 0], found[:, 1]), found[:, 2]]),
    )


def stretches(station: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, ...]:
    """Runs (k, 2) of neighbouring stations whose elevation is known; one station alone makes no line."""
    known = np.isfinite(h)
    border = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
    runs = np.split(np.arange(len(h)), border)
    return tuple(
        np.column_stack([station[run], h[run]]) for run in runs if len(run) > 1 and bool(known[run[0]])
    )


def _whole_squares(total: np.ndarray, every: int, across: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Bool image of squares that were cut whole, and the rows and columns between which they lie.

    A square reaches from one kept row and column to the next, these included; the last ones are always kept.
    """
    rows, columns = (
        np.unique(np.append(np.arange(0, count, step), count - 1))
        for count, step in zip((total.shape[0] - 1, total.shape[1] - 1), (every, across))
    )
    low, high = total[rows[:-1]], total[rows[1:] + 1]
    left, right = columns[:-1], columns[1:] + 1
    cut = high[:, right] - high[:, left] - low[:, right] + low[:, left]
    return cut == np.outer(np.diff(rows) + 1, np.diff(columns) + 1), np.ix_(rows, columns)


def _faces(index: np.ndarray, squares: np.ndarray, halves: bool) -> np.ndarray:
    """(m, 3) numbers of cells: two triangles for each whole square; with `halves`, one where three of four were cut."""
    near, far = index[:-1], index[1:]
    corners = np.stack([near[:, :-1], near[:, 1:], far[:, 1:], far[:, :-1]], axis=-1).astype(np.int64)
    whole = corners[squares]
    pieces = [np.stack([whole[:, [0, 1, 3]], whole[:, [1, 2, 3]]], axis=1).reshape(-1, 3)]
    if halves:
        there = corners >= 0
        three = there.sum(axis=-1) == 3
        pieces += [np.delete(corners[three & ~there[..., gone]], gone, axis=1) for gone in range(4)]
    return np.concatenate(pieces)


def _station_names(station: np.ndarray) -> list[str]:
    """`S0012.50` and so on: as many digits as it takes to tell the stations apart, two at least."""
    for digits in range(2, DECIMALS + 1):
        names = [f"S{value:0{5 + digits}.{digits}f}" for value in station]
        if len(set(names)) == len(names):
            break
    return names
