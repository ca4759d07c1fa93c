"""The independent check: total-station shots against the as-built surface.

Difference = as-built minus total station. The statement about accuracy rests on these and on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.surface.alignment import Alignment
from pipeline.surface.as_built import AsBuilt
from pipeline.surface.shots import Shots

COMPARED, OUTSIDE_CUT, OUTSIDE_ALIGNMENT = "compared", "outside the cut", "outside the alignment"
RADIUS_M = 0.10
"""Cells whose centres lie this close to a shot are compared with it: about the foot of a rod, and twice a cell."""
ENOUGH = 30
"""Fewer shots than this make an accuracy statement indicative only."""


@dataclass(frozen=True)
class Comparison:
    """One entry per shot; arrays (n,), nan where it was not compared."""

    station: np.ndarray
    offset: np.ndarray
    as_built_h: np.ndarray
    difference: np.ndarray
    """As-built minus total station, metres."""
    sigma: np.ndarray
    """Standard deviation of the as-built there, own and common parts, metres."""
    sigma_ts: np.ndarray
    """Standard deviation of the shot, metres."""
    z: np.ndarray
    """Difference over the combined standard deviation."""
    result: np.ndarray
    """compared, outside the cut, outside the alignment."""


@dataclass(frozen=True)
class CheckSummary:
    """Statistics of the compared shots; metres, nan without any."""

    n: int
    bias_m: float
    rmse_m: float
    worst_m: float
    """Of the largest size, with its sign."""
    worst_point: str
    reduced_chi_square: float
    """Mean of z²; about 1 where the sigmas are honest. The shots share the common errors, so it scatters more than
    a chi-square of n would."""
    indicative_only: bool


def compare(shots: Shots, built: AsBuilt, alignment: Alignment, sigma_ts_m: float) -> Comparison:
    """Each shot against the cut cells of the floor around it.

    Beside the floor nothing is compared: a control point there, on which the bucket was set down, is no shot of ground
    that was cut.

    Over the cells within `RADIUS_M` the deviation from the design is averaged and the design added at the shot, so
    that a floor with a gradient is not compared with the wrong place; outside the design plain elevations are.
    Sigma is the mean of the cells' sigmas: neighbours lie in the same sweeps and share their errors.

    Parameters
    ----------
    shots : Shots
        Grid metres.
    built : AsBuilt
        The surface.
    alignment : Alignment
        That the surface is along.
    sigma_ts_m : float
        Standard deviation of a shot's elevation.

    Returns
    -------
    Comparison
    """
    n = len(shots)
    grid = built.grid
    station, offset = alignment.station_offset(shots.p_grid[:, :2])
    as_built_h, sigma = np.full(n, np.nan), np.full(n, np.nan)
    result = np.full(n, OUTSIDE_CUT, object)
    reach = int(np.ceil(RADIUS_M / grid.cell_m)) + 1
    for i in range(n):
        if not alignment.start_station <= station[i] <= alignment.end_station:
            result[i] = OUTSIDE_ALIGNMENT
            continue
        row = int(np.floor((station[i] - grid.first_station) / grid.cell_m))
        column = int(np.floor((offset[i] - grid.first_offset) / grid.cell_m))
        if not (0 <= row < grid.rows and 0 <= column < grid.columns and built.floor[row, column]):
            continue  # beside the floor: the slope, or a control point next to the trench
        block = (
            slice(max(row - reach, 0), max(row + reach + 1, 0)),
            slice(max(column - reach, 0), max(column + reach + 1, 0)),
        )
        along, across = np.meshgrid(grid.station[block[0]], grid.offset[block[1]], indexing="ij")
        away = np.hypot(along - station[i], across - offset[i])
        # The nearest cell counts even where cells are larger than the radius.
        near = built.cut[block] & built.floor[block] & (away <= max(RADIUS_M, 0.75 * grid.cell_m))
        if not np.any(near):
            continue
        result[i] = COMPARED
        h = built.h[block][near]
        # A plane through the designed elevations of the cells carries their mean over to the shot.
        slope = _slope(np.where(built.floor[block], built.design_h[block], np.nan), grid.cell_m)
        toward = slope @ np.array([station[i] - along[near].mean(), offset[i] - across[near].mean()])
        as_built_h[i] = h.mean() + toward
        sigma[i] = np.hypot(built.sigma_own[block][near].mean(), built.sigma_common[block][near].mean())
    difference = as_built_h - shots.p_grid[:, 2]
    sigma_ts = np.full(n, sigma_ts_m)
    return Comparison(
        station=station,
        offset=offset,
        as_built_h=as_built_h,
        difference=difference,
        sigma=sigma,
        sigma_ts=sigma_ts,
        z=difference / np.hypot(sigma, sigma_ts),
        result=result,
    )


def summarise(shots: Shots, comparison: Comparison) -> CheckSummary:
    """n, bias, RMSE, worst and reduced chi-square of the compared shots."""
    compared = np.flatnonzero(comparison.result == COMPARED)
    if not len(compared):
        return CheckSummary(0, np.nan, np.nan, np.nan, "", np.nan, True)
    d, z = comparison.difference[compared], comparison.z[compared]
    worst = int(np.argmax(np.abs(d)))
    return CheckSummary(
        n=len(compared),
        bias_m=float(d.mean()),
        rmse_m=float(np.sqrt(np.mean(d**2))),
        worst_m=float(d[worst]),
        worst_point=str(shots.point[compared[worst]]),
        reduced_chi_square=float(np.mean(z**2)),
        indicative_only=len(compared) < ENOUGH,
    )


def _slope(design_h: np.ndarray, cell_m: float) -> np.ndarray:
    """Mean rise per metre along and across of a block of designed elevations; 0 where the design does not say."""
    slope = []
    for axis in (0, 1):
        rise = np.diff(design_h, axis=axis)
        rise = rise[np.isfinite(rise)]
        slope.append(float(np.median(rise)) / cell_m if len(rise) else 0.0)
    return np.array(slope)
