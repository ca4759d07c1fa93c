"""The sides of the trench: where its floor ends left and right, how wide it is, how its sides slope.

The ground is not where the edge has been, beside the floor as much as below it. So the side of the floor is the
outermost place that the swept edge reached low down. Rows of cells would tell it to a cell's width only; the ends of
the edge tell it to millimetres.

The outermost of several noisy passes lies too far out. Where passes lie across is the operator's hand, about normal:
with mean mu of a row and spread tau over the job, each pass is where it was estimated to be only as far as its noise
allows, and the side is the expectation of the outermost of them,

    pass k | estimate  ~  N(m_k, v_k)    m_k = mu + g_k (estimate - mu),  v_k = g_k own_k²
                                         g_k = tau² / (tau² + own_k²)
    E max  =  integral of x d(prod over k of Phi((x - m_k) / sqrt v_k))

The floor's way (`lowest_pass.py`) was tried first: neighbouring rows are crossed by the same few passes, from which its
density of heights cannot be told; in 2 of 12 drawn trenches it came out 1.2 sigma too narrow.

An error that moves the whole edge sideways moves both sides the same way: in the width it cancels, in the place of
either side it does not average out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.surface.as_built import AsBuilt
from pipeline.surface.design import Design
from pipeline.surface.one_sweep import sweeps_of
from pipeline.surface.sweep import EdgePath, SweepSettings

SIDES = ("left", "right")
LOW_M = 0.10
"""A pass tells the side of the floor while it is no higher than this above the designed floor."""
STEEPEST_ACROSS = 3.0
"""Run across per run along of the edge's path at most: where the edge itself crosses a row at a flatter angle, the
row's side would hang on a sliver."""
SLOPE_FROM_M, SLOPE_SPAN_M, SLOPE_CELLS = 0.15, 0.25, 12
"""A side slope is fitted to cut cells this far above the floor and more, over at least this rise and so many cells."""
_STEP_M, _HALVINGS = 0.05, 16
"""The designed side is looked for in steps, and between two of them by halving: to a micrometre."""
_TINY_M = 1e-6
_NEVER = np.iinfo(np.int64).min // 2


@dataclass(frozen=True)
class Reached:
    """Outermost passes of each row of cells; arrays (rows, 2): left, right; nan where no pass told them."""

    outward: np.ndarray
    """How far the side lies outside the designed one, metres."""
    own: np.ndarray
    """Own standard deviation, metres."""
    common: np.ndarray
    """Common standard deviation, metres."""
    time_ns: np.ndarray
    """int64: when the outermost pass was."""


@dataclass(frozen=True)
class SideRows(Reached):
    """Sides of each row of cells."""

    border: np.ndarray
    """(rows, 2) distance of the designed side from the alignment, metres."""
    in_plan: Reached
    """The outermost place of the edge as it lies, where `outward` goes down along the designed slope to the floor."""


@dataclass(frozen=True)
class Sides:
    """Sides of the floor; one entry per station and side, arrays (n, 2): left, right. nan where not told."""

    station: np.ndarray
    """(n,) metres."""
    outward: np.ndarray
    """How far the side lies outside the designed one, + wide, - narrow, metres."""
    sigma_own: np.ndarray
    sigma_common: np.ndarray
    """Common part: one error of the edge across the alignment, with opposite signs outward at left and right."""
    slope: np.ndarray
    """Run per rise of the side above the floor, as it was cut."""
    sigma_slope: np.ndarray
    design_width: np.ndarray
    """(n,) designed width of the floor, metres."""
    rows: SideRows
    """What the stations are means of."""

    @property
    def width(self) -> np.ndarray:
        """(n,) width of the floor as it was cut, metres."""
        return self.design_width + self.outward.sum(axis=1)

    @property
    def sigma_width_own(self) -> np.ndarray:
        """(n,) metres."""
        return np.hypot(self.sigma_own[:, 0], self.sigma_own[:, 1])

    @property
    def sigma_width_common(self) -> np.ndarray:
        """(n,) metres: what common errors across do not cancel; heights, which tell on sloped sides, are left out."""
        return np.abs(self.sigma_common[:, 0] - self.sigma_common[:, 1])


def sides(
    path: EdgePath,
    built: AsBuilt,
    design: Design,
    station: np.ndarray,
    step_m: float,
    settings: SweepSettings | None = None,
) -> Sides:
    """The sides of the floor at each station.

    Parameters
    ----------
    path : EdgePath
        The cutting edge along the alignment.
    built : AsBuilt
        Its surface: its rows are those in which sides are looked for, its cells beside the floor tell the slopes.
    design : Design
        What was to be dug.
    station : (n,) array
        Metres, ascending: each stands for half a step to either side.
    step_m : float
        Their distance.
    settings : SweepSettings, optional
        Its `pass_gap_s`.

    Returns
    -------
    Sides
    """
    settings = settings or SweepSettings()
    grid = built.grid
    level = design.floor_level(grid.station)
    border, flare = _designed_sides(design, grid.station, level)
    at = _rows(path, built, level, border, flare, settings)
    # A row tells its sides only where its floor was cut: a single pass beside an uncut floor is no side of it.
    cut_row = (built.cut & built.floor).any(axis=1)
    n = len(station)
    result = {
        name: np.full((n, 2), np.nan)
        for name in ("outward", "sigma_own", "sigma_common", "slope", "sigma_slope")
    }
    edges = np.searchsorted(
        grid.station, np.concatenate([station - 0.5 * step_m, station[-1:] + 0.5 * step_m])
    )
    for i in range(n):
        rows = slice(edges[i], edges[i + 1])
        for side in (0, 1):
            rows_told = np.flatnonzero(np.isfinite(at.outward[rows, side]) & cut_row[rows]) + edges[i]
            if 2 * len(rows_told) > max(edges[i + 1] - edges[i], 1):
                result["outward"][i, side] = at.outward[rows_told, side].mean()
                sweeps = sweeps_of(at.own[rows_told, side], at.time_ns[rows_told, side])
                result["sigma_own"][i, side] = np.sqrt(np.sum(sweeps**2)) / len(rows_told)
                result["sigma_common"][i, side] = at.common[rows_told, side].mean()
            result["slope"][i, side], result["sigma_slope"][i, side] = _slope(built, level, rows, side)
    width = np.interp(station, grid.station, border.sum(axis=1), left=np.nan, right=np.nan)
    return Sides(station=station, design_width=width, rows=at, **result)


def _designed_sides(design: Design, station: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows, 2) distance of each side of the designed floor from the alignment, and run per rise above it; metres."""
    reach = min(design.floor_reach(), 50.0) + 1.0
    offset = np.arange(-reach, reach + 0.5 * _STEP_M, _STEP_M)
    on_floor = np.array([design.is_floor(np.full(len(offset), here), offset) for here in station]).reshape(
        len(station), len(offset)
    )
    there = on_floor.any(axis=1) & np.isfinite(level)
    border, flare = np.full((len(station), 2), np.nan), np.zeros((len(station), 2))
    for side, sign in ((0, -1.0), (1, 1.0)):
        outermost = (
            np.argmax(on_floor, axis=1)
            if side == 0
            else len(offset) - 1 - np.argmax(on_floor[:, ::-1], axis=1)
        )
        inside = offset[outermost]
        outside = inside + sign * _STEP_M
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            floor = design.is_floor(station, middle)
            inside, outside = np.where(floor, middle, inside), np.where(floor, outside, middle)
        border[:, side] = np.where(there, sign * inside, np.nan)
        rise = design.elevation(station, inside + sign * LOW_M) - level
        sloped = there & np.isfinite(rise) & (rise > 1e-6)
        flare[:, side] = np.where(sloped, LOW_M / np.where(sloped, rise, 1.0), 0.0)
    return border, flare


def _rows(
    path: EdgePath,
    built: AsBuilt,
    level: np.ndarray,
    border: np.ndarray,
    flare: np.ndarray,
    settings: SweepSettings,
) -> SideRows:
    grid = built.grid

    def reached(flare: np.ndarray) -> Reached:
        first, outward, own, common, time_ns = _passes(
            path, grid.station, grid.cell_m, level, border, flare, round(settings.pass_gap_s * 1e9)
        )
        side, sigma, of_pass = _outermost(first, outward, own)
        told = of_pass >= 0
        shared, when = np.full(len(told), np.nan), np.zeros(len(told), np.int64)
        shared[told], when[told] = common[of_pass[told]], time_ns[of_pass[told]]
        return Reached(*(part.reshape(grid.rows, 2) for part in (side, sigma, shared, when)))

    at = reached(flare)
    in_plan = reached(np.zeros_like(flare)) if flare.any() else at
    return SideRows(at.outward, at.own, at.common, at.time_ns, border, in_plan)


def _passes(
    path: EdgePath, station: np.ndarray, cell_m: float, level: np.ndarray, border: np.ndarray,
    flare: np.ndarray, gap_ns: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Outermost place of each pass at each row and side, ordered by row, side and time.

    Returns ``first`` (2 rows + 1,), then per pass: outward of the designed side, own and common sigma, metres; time.
    """
    arguments = (
        path.time_ns,
        path.soh,
        path.own,
        path.common,
        path.swept,
        station,
        cell_m,
        level,
        border,
        flare,
        gap_ns,
    )
    cells = 2 * len(station)
    count = np.zeros(cells, np.int64)
    nothing, no_time = np.zeros(0), np.zeros(0, np.int64)
    _reach(*arguments, False, count, no_time, nothing, nothing, nothing, no_time)
    first = np.concatenate([[0], np.cumsum(count)])
    outward = np.full(first[-1], -np.inf)
    own, common, time_ns = np.empty(first[-1]), np.empty(first[-1]), np.empty(first[-1], np.int64)
    count[:] = 0
    _reach(*arguments, True, count, first, outward, own, common, time_ns)
    return first, outward, own, common, time_ns


def _outermost(
    first: np.ndarray, outward: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the outermost pass of each row and side was, its own sigma, and which pass it seems to be (-1: none)."""
    cells = len(first) - 1
    side, sigma, which = np.full(cells, np.nan), np.full(cells, np.nan), np.full(cells, -1, np.int64)
    count = np.diff(first)
    several = count > 1
    tau2 = 0.0
    if np.any(several):
        start = first[:-1][count > 0]
        n = count[count > 0]
        mean = np.add.reduceat(outward, start) / n
        square = np.add.reduceat((outward - np.repeat(mean, n)) ** 2, start)
        noise = np.add.reduceat(own**2, start) / n
        more = n > 1
        tau2 = max(float(np.mean((square[more] / (n[more] - 1)) - noise[more])), 0.0)
    _expected_maximum(first, outward, np.maximum(own, _TINY_M), tau2, side, sigma, which)
    return side, sigma, which


@njit(cache=True, nogil=True)
def _expected_maximum(first, value, own, tau2, side, sigma, which):  # pragma: no cover - compiled
    steps = 60
    for c in range(len(first) - 1):
        begin, end = first[c], first[c + 1]
        n = end - begin
        if n == 0:
            continue
        mu = 0.0
        for p in range(begin, end):
            mu += value[p] / n
            if which[c] < 0 or value[p] > value[which[c]]:
                which[c] = p
        if n == 1:
            side[c], sigma[c] = value[begin], own[begin]
            continue
        low, high, widest = -1e9, -1e9, 0.0
        for p in range(begin, end):
            g = tau2 / (tau2 + own[p] ** 2)
            m, s = mu + g * (value[p] - mu), math.sqrt(g) * own[p] + 1e-9
            low, high = max(low, m - 5.0 * s), max(high, m + 5.0 * s)
            widest = max(widest, own[p] * own[p] / n)
        step = (high - low) / steps
        before = 0.0
        mean = square = 0.0
        for i in range(steps + 1):
            x = low + i * step
            below = 1.0
            for p in range(begin, end):
                g = tau2 / (tau2 + own[p] ** 2)
                m, s = mu + g * (value[p] - mu), math.sqrt(g) * own[p] + 1e-9
                below *= 0.5 * math.erfc((m - x) / s * 0.7071067811865476)
            at = x - 0.5 * step if i > 0 else x
            mean += (below - before) * at
            square += (below - before) * at * at
            before = below
        side[c] = mean
        # The mean of the row is not known better than its passes allow, and moves all of them.
        g = tau2 / (tau2 + own[which[c]] ** 2)
        sigma[c] = math.sqrt(max(square - mean * mean, 0.0) + (1.0 - g) ** 2 * widest)


@njit(cache=True, nogil=True)
def _spread_of(cov, g_s, g_o, g_h):  # pragma: no cover - compiled
    """Standard deviation of g . error for an error of upper triangle cov (6,)."""
    variance = (
        g_s * g_s * cov[0]
        + 2.0 * g_s * g_o * cov[1]
        + 2.0 * g_s * g_h * cov[2]
        + g_o * g_o * cov[3]
        + 2.0 * g_o * g_h * cov[4]
        + g_h * g_h * cov[5]
    )
    return np.sqrt(max(variance, 0.0))


@njit(cache=True, nogil=True)
def _reach(
    time_ns, soh, own, common, swept, station, cell, level, border, flare, gap_ns, fill,
    count, first, outward, sigma_own, sigma_common, pass_time,
):  # fmt: skip  # pragma: no cover - compiled
    """Walk the six line pieces of each swept strip over the rows of cells that they cross."""
    rows = len(station)
    last = np.full(2 * rows, _NEVER)
    begin_k, begin_i = np.empty(6, np.int64), np.empty(6, np.int64)
    end_k, end_i = np.empty(6, np.int64), np.empty(6, np.int64)
    for k in range(len(swept)):
        if not swept[k]:
            continue
        # The ends' paths, and both halves of the edge at both instants.
        for c in range(2):
            begin_k[c], begin_i[c], end_k[c], end_i[c] = k, 2 * c, k + 1, 2 * c
            begin_k[2 + c], begin_i[2 + c], end_k[2 + c], end_i[2 + c] = k, c, k, c + 1
            begin_k[4 + c], begin_i[4 + c], end_k[4 + c], end_i[4 + c] = k + 1, c, k + 1, c + 1
        for c in range(6):
            a, b = soh[begin_k[c], begin_i[c]], soh[end_k[c], end_i[c]]
            run = b[0] - a[0]
            if abs(run) < 1e-9 or abs(b[1] - a[1]) > STEEPEST_ACROSS * abs(run):
                continue
            low = max(int(np.ceil((min(a[0], b[0]) - station[0]) / cell)), 0)
            high = min(int(np.floor((max(a[0], b[0]) - station[0]) / cell)), rows - 1)
            m, n = (b[1] - a[1]) / run, (b[2] - a[2]) / run
            if abs(n) > STEEPEST_ACROSS:
                continue
            for r in range(low, high + 1):
                w = (station[r] - a[0]) / run
                offset, z = a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])
                rise = z - level[r]
                if not rise <= LOW_M:  # nan levels too
                    continue
                side = 0 if offset < 0.0 else 1
                outside = 1.0 if side == 1 else -1.0
                grow = flare[r, side] if rise > 0.0 else 0.0
                at = 2 * r + side
                now = time_ns[k]
                if now - last[at] > gap_ns:
                    count[at] += 1
                last[at] = now
                if not fill:
                    continue
                reached = outside * offset - border[r, side] - grow * max(rise, 0.0)
                slot = first[at] + count[at] - 1
                if reached > outward[slot]:
                    g_s, g_o, g_h = -outside * m + grow * n, outside, -grow
                    outward[slot] = reached
                    one, other = own[begin_k[c], begin_i[c]], own[end_k[c], end_i[c]]
                    sigma_own[slot] = (1.0 - w) * _spread_of(one, g_s, g_o, g_h) + w * _spread_of(
                        other, g_s, g_o, g_h
                    )
                    one, other = common[begin_k[c], begin_i[c]], common[end_k[c], end_i[c]]
                    sigma_common[slot] = (1.0 - w) * _spread_of(one, g_s, g_o, g_h) + w * _spread_of(
                        other, g_s, g_o, g_h
                    )
                    pass_time[slot] = now


def _slope(built: AsBuilt, level: np.ndarray, rows: slice, side: int) -> tuple[float, float]:
    """Run per rise of one side of one station and its standard deviation; nan where too little of it was cut."""
    outward = built.grid.offset * (1.0 if side else -1.0)
    rise = built.h[rows] - level[rows, None]
    cells = built.cut[rows] & ~built.floor[rows] & (outward > 0)[None, :] & (rise > SLOPE_FROM_M)
    if np.count_nonzero(cells) < SLOPE_CELLS:
        return np.nan, np.nan
    x = np.broadcast_to(outward, rise.shape)[cells]
    y, own, when = rise[cells], built.sigma_own[rows][cells], built.lowest_time_ns[rows][cells]
    if np.ptp(y) < SLOPE_SPAN_M or np.ptp(x) < 2 * built.grid.cell_m:
        return np.nan, np.nan
    weight = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    rate = float(weight @ y)
    if rate < 0.1:
        return np.nan, np.nan
    left_over = y - y.mean() - rate * (x - x.mean())
    # Cells of one sweep share their error; where they scatter more than that, the scatter counts.
    of_noise = np.sqrt(np.sum(sweeps_of(np.abs(weight) * own, when) ** 2))
    of_scatter = np.sqrt(np.sum(left_over**2) / max(len(y) - 2, 1) * np.sum(weight**2))
    return 1.0 / rate, float(np.hypot(of_noise, of_scatter)) / rate**2
