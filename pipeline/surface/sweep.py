"""The swept cutting edge on cells of station and offset: which sweep crossed which cell, and how high.

Between two epochs the edge sweeps a strip, cut into four triangles (left to middle, middle to right). Where a
triangle covers the centre of a cell, the edge was there, at the height of the triangle. Crossings of one cell that
follow each other within `SweepSettings.pass_gap_s` are one **pass**: the errors of neighbouring epochs are nearly
the same error, and a second look through it is no second look.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.surface.alignment import Alignment
from pipeline.tracks.poses import CuttingEdge

_CHUNK = 65_536
_NEVER = np.iinfo(np.int64).min // 2
STEEPEST = 3.0
"""Rise per run of a swept triangle, at most, when a horizontal error is turned into a vertical one. Near-vertical
slivers have any slope, and no cell's height should hang on it."""


@dataclass(frozen=True)
class SweepSettings:
    """Knobs of the sweep."""

    max_step_s: float = 0.5
    """Longest time between two epochs that is swept. The edge accelerates by about 1 m/s²: over half a second it
    leaves the interpolated path by millimetres, over a second by centimetres."""
    interpolation_s: float = 0.06
    """Longer steps are cut by cubic interpolation; a straight chord of 0.2 s lies 5 mm above a path that is bent
    by 1 m/s², and it is the bottom of the bend that becomes the floor."""
    pass_gap_s: float = 1.0
    """A cell crossed again after this long is crossed by another pass."""


@dataclass(frozen=True)
class CellGrid:
    """Square cells along the alignment."""

    cell_m: float
    first_station: float
    """Lower border of the first row of cells, metres."""
    first_offset: float
    """Lower border of the first column."""
    rows: int
    """Cells along the alignment."""
    columns: int
    """Cells across."""

    @property
    def station(self) -> np.ndarray:
        """(rows,) centres, metres."""
        return self.first_station + (np.arange(self.rows) + 0.5) * self.cell_m

    @property
    def offset(self) -> np.ndarray:
        """(columns,) centres, metres."""
        return self.first_offset + (np.arange(self.columns) + 0.5) * self.cell_m

    @property
    def size(self) -> int:
        return self.rows * self.columns


@dataclass(frozen=True)
class EdgePath:
    """The cutting edge along the alignment, ready to be swept."""

    time_ns: np.ndarray
    """(n,) int64."""
    soh: np.ndarray
    """(n, 3, 3): left, middle, right; station, offset, elevation, metres."""
    own: np.ndarray
    """(n, 3, 6) float32: upper triangle of the own covariance along station, offset, elevation, m²."""
    common: np.ndarray
    """(n, 3, 6) float32: of the common covariance."""
    swept: np.ndarray
    """(n - 1,) bool: the edge is known all the way from this epoch to the next."""

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True)
class Passes:
    """All passes of the edge over the cells of a grid, cell after cell; within a cell in the order of time.

    Only what stayed below the ceiling is kept pass by pass; what flew above it is counted.
    """

    first: np.ndarray
    """(cells + 1,) int64: passes of cell k are ``first[k]:first[k + 1]``."""
    height: np.ndarray
    """(p,) lowest elevation of the edge over the cell's centre within the pass, metres."""
    sigma_own: np.ndarray
    """(p,) own part of its standard deviation, slope of the sweep included, metres."""
    sigma_common: np.ndarray
    """(p,) common part, metres."""
    time_ns: np.ndarray
    """(p,) when it was."""
    crossed: np.ndarray
    """(cells,) int32: passes at any height."""
    lowest: np.ndarray
    """(cells,) lowest elevation at any height; inf where never crossed."""
    lowest_time_ns: np.ndarray
    """(cells,) int64: when."""

    @property
    def count(self) -> np.ndarray:
        """(cells,) passes below the ceiling."""
        return np.diff(self.first)


def path_along(edge: CuttingEdge, alignment: Alignment, settings: SweepSettings | None = None) -> EdgePath:
    """The cutting edge in station, offset and elevation, with long steps cut into short ones.

    Parameters
    ----------
    edge : CuttingEdge
        In grid metres; epochs that are not `seen` end the sweep before and after them.
    alignment : Alignment
        The axis of the trench.
    settings : SweepSettings, optional
        Its `max_step_s` and `interpolation_s`.

    Returns
    -------
    EdgePath
    """
    settings = settings or SweepSettings()
    n = len(edge)
    soh = np.empty((n, 3, 3))
    own, common = np.empty((n, 3, 6), np.float32), np.empty((n, 3, 6), np.float32)
    for begin in range(0, n, _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        p = edge.p_grid[rows]
        station, offset = alignment.station_offset(p[..., :2])
        soh[rows] = np.stack([station, offset, p[..., 2]], axis=-1)
        east, north = _axes(alignment, station)
        cov, shared = edge.cov[rows], edge.common[rows]
        own[rows] = _rotated(cov - shared, east, north)
        common[rows] = _rotated(shared, east, north)
    step = np.diff(edge.time_ns)
    swept = edge.seen[1:] & edge.seen[:-1] & (step > 0) & (step <= round(settings.max_step_s * 1e9))
    if n > 1:
        # Behind a sharp corner of the alignment stations jump; nothing there is a strip of ground.
        jump = np.max(np.abs(np.diff(soh[:, :, 0], axis=0)), axis=1)
        walked = np.max(np.linalg.norm(np.diff(edge.p_grid[..., :2], axis=0), axis=-1), axis=1)
        width = np.linalg.norm(soh[:, 2, :2] - soh[:, 0, :2], axis=-1)
        torn = width > 1.5 * np.linalg.norm(edge.p_grid[:, 2, :2] - edge.p_grid[:, 0, :2], axis=-1) + 0.05
        swept &= (jump <= 2 * walked + 0.05) & ~torn[1:] & ~torn[:-1]
    return _finer(EdgePath(edge.time_ns, soh, own, common, swept), settings)


def sweep(
    path: EdgePath, grid: CellGrid, ceiling: np.ndarray, settings: SweepSettings | None = None
) -> Passes:
    """Every pass of the edge over every cell.

    Two runs over the path, one that counts and one that fills, so memory is known beforehand and nothing is sorted.

    Parameters
    ----------
    path : EdgePath
        See `path_along`.
    grid : CellGrid
        The cells.
    ceiling : (rows, columns) array
        Elevation above which a crossing is counted and not kept, metres; nan keeps none.
    settings : SweepSettings, optional
        Its `pass_gap_s`.

    Returns
    -------
    Passes
    """
    settings = settings or SweepSettings()
    assert ceiling.shape == (grid.rows, grid.columns), (ceiling.shape, grid)
    cells = grid.size
    limit = np.where(np.isnan(ceiling), -np.inf, ceiling).ravel()
    gap_ns = round(settings.pass_gap_s * 1e9)
    corner = np.array([grid.first_station, grid.first_offset])
    shape = np.array([grid.rows, grid.columns])
    arguments = (
        path.time_ns,
        path.soh,
        path.own,
        path.common,
        path.swept,
        corner,
        grid.cell_m,
        shape,
        limit,
        gap_ns,
    )

    crossed, count = np.zeros(cells, np.int32), np.zeros(cells, np.int64)
    lowest, lowest_time = np.full(cells, np.inf), np.full(cells, _NEVER)
    last, last_low = np.full(cells, _NEVER), np.full(cells, _NEVER)
    nothing, no_time = np.zeros(0), np.zeros(0, np.int64)
    _cross(
        *arguments, False, last, last_low, crossed, count, lowest, lowest_time,
        no_time, nothing, nothing, nothing, no_time,
    )  # fmt: skip
    first = np.concatenate([[0], np.cumsum(count)])
    total = int(first[-1])
    height, sigma_own, sigma_common = np.full(total, np.inf), np.empty(total), np.empty(total)
    time_ns = np.empty(total, np.int64)
    count[:] = 0
    last_low[:] = _NEVER
    _cross(
        *arguments, True, last, last_low, crossed, count, lowest, lowest_time,
        first, height, sigma_own, sigma_common, time_ns,
    )  # fmt: skip
    assert np.array_equal(count, np.diff(first))
    return Passes(first, height, sigma_own, sigma_common, time_ns, crossed, lowest, lowest_time)


def _axes(alignment: Alignment, station: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Easting and northing parts of the direction along the alignment at stations."""
    inside = np.clip(station, alignment.start_station, alignment.end_station)
    element = np.clip(
        np.searchsorted(alignment.station, inside, side="right") - 1, 0, len(alignment.turn) - 1
    )
    direction = alignment.directions(element, inside - alignment.station[element])
    return direction[..., 0], direction[..., 1]


def _rotated(cov: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Upper triangles (..., 6) from easting, northing, elevation to station, offset (to the right), elevation."""
    ee, en, eh, nn, nh, hh = np.moveaxis(cov, -1, 0)
    out = np.empty(cov.shape, np.float32)
    out[..., 0] = east * east * ee + 2 * east * north * en + north * north * nn
    out[..., 1] = east * north * ee + (north * north - east * east) * en - east * north * nn
    out[..., 2] = east * eh + north * nh
    out[..., 3] = north * north * ee - 2 * east * north * en + east * east * nn
    out[..., 4] = north * eh - east * nh
    out[..., 5] = hh
    return out


def _finer(path: EdgePath, settings: SweepSettings) -> EdgePath:
    """The path with each swept step longer than `interpolation_s` cut by a cubic through its neighbours."""
    step_s = np.diff(path.time_ns) * 1e-9
    parts = np.ones(len(step_s), np.int64)
    long = path.swept & (step_s > settings.interpolation_s)
    parts[long] = np.ceil(step_s[long] / settings.interpolation_s).astype(np.int64)
    if not np.any(long):
        return path
    # Slope at each epoch: that of the parabola through it and its neighbours, or of the one step that is swept.
    rate = np.diff(path.soh, axis=0) / np.where(step_s > 0, step_s, 1.0)[:, None, None]
    before, after = np.append(False, path.swept), np.append(path.swept, False)
    wait, ahead = np.append(1.0, step_s), np.append(step_s, 1.0)
    weight = np.where(before & after, wait / (wait + ahead), np.where(after, 1.0, 0.0))[:, None, None]
    slope = weight * np.concatenate([rate, np.zeros((1, 3, 3))])
    slope += (1 - weight) * np.concatenate([np.zeros((1, 3, 3)), rate])

    k = np.repeat(np.arange(len(parts)), parts)
    u = (np.arange(len(k)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[k]
    v, dt = u[:, None, None], step_s[k][:, None, None]
    a, b = path.soh[k], path.soh[k + 1]
    soh = a * ((1 + 2 * v) * (1 - v) ** 2) + b * (v * v * (3 - 2 * v))
    soh += dt * (slope[k] * (v * (1 - v) ** 2) + slope[k + 1] * (v * v * (v - 1)))
    w = v.astype(np.float32)
    time_ns = path.time_ns[k] + np.round(u * np.diff(path.time_ns)[k]).astype(np.int64)
    return EdgePath(
        time_ns=np.append(time_ns, path.time_ns[-1]),
        soh=np.concatenate([soh, path.soh[-1:]]),
        own=np.concatenate([path.own[k] * (1 - w) + path.own[k + 1] * w, path.own[-1:]]),
        common=np.concatenate([path.common[k] * (1 - w) + path.common[k + 1] * w, path.common[-1:]]),
        swept=path.swept[k],
    )


@njit(cache=True, nogil=True)
def _sigma(cov, g_s, g_o):  # pragma: no cover - compiled
    """Vertical standard deviation of a point on a plane of slope g that moves by the errors of cov (6,)."""
    variance = (
        cov[5]
        - 2.0 * (g_s * cov[2] + g_o * cov[4])
        + g_s * g_s * cov[0]
        + 2.0 * g_s * g_o * cov[1]
        + g_o * g_o * cov[3]
    )
    return np.sqrt(max(variance, 0.0))


@njit(cache=True, nogil=True)
def _cross(
    time_ns, soh, own, common, swept, corner, cell, shape, limit, gap_ns, fill,
    last, last_low, crossed, count, lowest, lowest_time, first, height, sigma_own, sigma_common, pass_time,
):  # fmt: skip  # pragma: no cover - compiled
    rows, columns = shape[0], shape[1]
    corner_k = np.empty(3, np.int64)
    corner_i = np.empty(3, np.int64)
    x = np.empty(3)
    y = np.empty(3)
    h = np.empty(3)
    s_own = np.empty(3)
    s_common = np.empty(3)
    for k in range(len(swept)):
        if not swept[k]:
            continue
        for half in range(2):
            for upper in range(2):
                # The two triangles of one strip between points half and half + 1, epochs k and k + 1.
                if upper == 0:
                    corner_k[0], corner_i[0] = k, half
                    corner_k[1], corner_i[1] = k, half + 1
                    corner_k[2], corner_i[2] = k + 1, half
                else:
                    corner_k[0], corner_i[0] = k, half + 1
                    corner_k[1], corner_i[1] = k + 1, half + 1
                    corner_k[2], corner_i[2] = k + 1, half
                for c in range(3):
                    p = soh[corner_k[c], corner_i[c]]
                    # Cell centres are at whole numbers.
                    x[c] = (p[0] - corner[0]) / cell - 0.5
                    y[c] = (p[1] - corner[1]) / cell - 0.5
                    h[c] = p[2]
                i_low = max(int(np.ceil(min(x[0], x[1], x[2]))), 0)
                i_high = min(int(np.floor(max(x[0], x[1], x[2]))), rows - 1)
                j_low = max(int(np.ceil(min(y[0], y[1], y[2]))), 0)
                j_high = min(int(np.floor(max(y[0], y[1], y[2]))), columns - 1)
                if i_low > i_high or j_low > j_high:
                    continue
                x1, y1, h1 = x[1] - x[0], y[1] - y[0], h[1] - h[0]
                x2, y2, h2 = x[2] - x[0], y[2] - y[0], h[2] - h[0]
                area = x1 * y2 - x2 * y1
                if abs(area) < 1e-12:
                    continue
                if fill:
                    g_s = (h1 * y2 - h2 * y1) / (area * cell)
                    g_o = (h2 * x1 - h1 * x2) / (area * cell)
                    steep = np.sqrt(g_s * g_s + g_o * g_o)
                    if steep > STEEPEST:
                        g_s *= STEEPEST / steep
                        g_o *= STEEPEST / steep
                    for c in range(3):
                        s_own[c] = _sigma(own[corner_k[c], corner_i[c]], g_s, g_o)
                        s_common[c] = _sigma(common[corner_k[c], corner_i[c]], g_s, g_o)
                for i in range(i_low, i_high + 1):
                    for j in range(j_low, j_high + 1):
                        dx, dy = i - x[0], j - y[0]
                        w1 = (dx * y2 - x2 * dy) / area
                        w2 = (x1 * dy - dx * y1) / area
                        if w1 < -1e-9 or w2 < -1e-9 or w1 + w2 > 1.0 + 1e-9:
                            continue
                        at = i * columns + j
                        now = time_ns[k]
                        z = h[0] + w1 * h1 + w2 * h2
                        if not fill:
                            if now - last[at] > gap_ns:
                                crossed[at] += 1
                            last[at] = now
                            if z < lowest[at]:
                                lowest[at] = z
                                lowest_time[at] = now
                        if z > limit[at]:
                            continue
                        if now - last_low[at] > gap_ns:
                            count[at] += 1
                        last_low[at] = now
                        if fill:
                            slot = first[at] + count[at] - 1
                            if z < height[slot]:
                                height[slot] = z
                                sigma_own[slot] = (
                                    s_own[0] + w1 * (s_own[1] - s_own[0]) + w2 * (s_own[2] - s_own[0])
                                )
                                sigma_common[slot] = (
                                    s_common[0]
                                    + w1 * (s_common[1] - s_common[0])
                                    + w2 * (s_common[2] - s_common[0])
                                )
                                pass_time[slot] = now
