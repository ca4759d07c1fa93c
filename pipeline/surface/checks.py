"""The independent check: total-station shots against the as-built surface, and the parked edge (`parked`).

Difference = ours minus total station. The statement about accuracy rests on these and on nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.surface.alignment import Alignment
from pipeline.surface.as_built import AsBuilt
from pipeline.surface.shots import NO_TIME, Shots

COMPARED, OUTSIDE_CUT, OUTSIDE_ALIGNMENT = "compared", "outside the cut", "outside the alignment"
USED = "used in calibration"
RADIUS_M = 0.10
"""Cells whose centres lie this close to a shot are compared with it: about the foot of a rod, and twice a cell."""
ENOUGH = 30
"""Fewer shots than this make an accuracy statement indicative only."""


@dataclass(frozen=True)
class Comparison:
    """One entry per shot; arrays (n,) unless said otherwise, nan where it was not compared."""

    station: np.ndarray
    offset: np.ndarray
    as_built_h: np.ndarray
    """Our elevation there: of the as-built floor, or of the edge."""
    difference: np.ndarray
    """Ours minus total station in elevation, metres."""
    difference_e: np.ndarray
    """The same in easting, of the edge only."""
    difference_n: np.ndarray
    own: np.ndarray
    """(n, 3, 3) own part of our covariance, along easting, northing, elevation, m²; of the floor elevation only."""
    common: np.ndarray
    """(n, 3, 3) common part."""
    sigma_ts: np.ndarray
    """Standard deviation of each coordinate of the shot, metres."""
    time_ns: np.ndarray
    """int64: of the pass that cut the floor there, or of the rest of the edge; NO_TIME where there is none."""
    edge_point: np.ndarray
    """left, middle, right, or nearest; empty for the floor."""
    along_en: np.ndarray
    """(n, 2) direction of the edge, where only the nearest place on it was compared."""
    gradient: np.ndarray
    """(n, 2) rise of the floor per metre along the alignment and across, by the design."""
    result: np.ndarray
    """compared, or why not."""

    @property
    def sigma_own(self) -> np.ndarray:
        """Own part of the standard deviation of our elevation, metres."""
        return np.sqrt(self.own[:, 2, 2])

    @property
    def sigma_common(self) -> np.ndarray:
        """Common part."""
        return np.sqrt(self.common[:, 2, 2])

    @property
    def sigma(self) -> np.ndarray:
        """Of our elevation, own and common parts, metres."""
        return np.hypot(self.sigma_own, self.sigma_common)

    @property
    def z(self) -> np.ndarray:
        """Difference over the combined standard deviation."""
        return self.difference / np.hypot(self.sigma, self.sigma_ts)


@dataclass(frozen=True)
class CheckSummary:
    """Statistics of the compared shots of one kind; metres, nan without any."""

    n: int
    bias_m: float
    rmse_m: float
    worst_m: float
    """Of the largest size, with its sign."""
    worst_point: str
    reduced_chi_square: float
    """Mean of z²; about 1 where the sigmas are honest. The shots share the common errors, so it scatters more than
    a chi-square of n would."""
    horizontal_rmse_m: float
    """Of the distance in plan, of the edge; nan for the floor."""
    indicative_only: bool


def compare(shots: Shots, built: AsBuilt, alignment: Alignment, sigma_ts_m: float) -> Comparison:
    """Each shot of the floor against the cut cells around it.

    Beside the floor nothing is compared: a control point there, on which the bucket was set down, is no shot of ground
    that was cut.

    Over the cells within `RADIUS_M` the deviation from the design is averaged and the design added at the shot, so
    that a floor with a gradient is not compared with the wrong place; outside the design plain elevations are.
    Sigma is the mean of the cells' sigmas: neighbours lie in the same sweeps and share their errors.

    Parameters
    ----------
    shots : Shots
        Grid metres; those of other kinds are left for `parked.compare_parked`.
    built : AsBuilt
        The surface.
    alignment : Alignment
        That the surface is along.
    sigma_ts_m : float
        Standard deviation of a shot's coordinates, where it has none of its own.

    Returns
    -------
    Comparison
    """
    n = len(shots)
    grid = built.grid
    station, offset = alignment.station_offset(shots.p_grid[:, :2])
    as_built_h, gradient = np.full(n, np.nan), np.full((n, 2), np.nan)
    own, common = np.full((n, 3, 3), np.nan), np.full((n, 3, 3), np.nan)
    time_ns = np.full(n, NO_TIME, np.int64)
    result = np.full(n, OUTSIDE_CUT, object)
    reach = int(np.ceil(RADIUS_M / grid.cell_m)) + 1
    for i in np.flatnonzero(shots.kind == "floor"):
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
        gradient[i] = slope
        own[i], common[i] = np.zeros((3, 3)), np.zeros((3, 3))
        own[i, 2, 2] = built.sigma_own[block][near].mean() ** 2
        common[i, 2, 2] = built.sigma_common[block][near].mean() ** 2
        time_ns[i] = built.lowest_time_ns[block][near][np.argmin(away[near])]
    return Comparison(
        station=station,
        offset=offset,
        as_built_h=as_built_h,
        difference=as_built_h - shots.p_grid[:, 2],
        difference_e=np.full(n, np.nan),
        difference_n=np.full(n, np.nan),
        own=own,
        common=common,
        sigma_ts=np.where(np.isfinite(shots.sigma_m), shots.sigma_m, sigma_ts_m),
        time_ns=time_ns,
        edge_point=np.full(n, "", object),
        along_en=np.full((n, 2), np.nan),
        gradient=gradient,
        result=result,
    )


def without_used(shots: Shots, comparison: Comparison, used: Sequence[str]) -> Comparison:
    """The comparison with points that the machine was calibrated with marked: they prove nothing.

    An entry of `used` is an id, a whole description, or its first word.
    """
    names = set(used)
    found = comparison.result.copy()
    for i in range(len(shots)):
        code = str(shots.code[i])
        if names & {str(shots.point[i]), code, *code.split()[:1]}:
            found[i] = USED
    return replace(comparison, result=found)


def summarise(shots: Shots, comparison: Comparison, kind: str = "floor") -> CheckSummary:
    """n, bias, RMSE, worst and reduced chi-square of the compared shots of a kind, in elevation, and RMSE in plan."""
    compared = np.flatnonzero((comparison.result == COMPARED) & (shots.kind == kind))
    if not len(compared):
        return CheckSummary(0, np.nan, np.nan, np.nan, "", np.nan, np.nan, True)
    d, z = comparison.difference[compared], comparison.z[compared]
    away = comparison.difference_e[compared] ** 2 + comparison.difference_n[compared] ** 2
    worst = int(np.argmax(np.abs(d)))
    return CheckSummary(
        n=len(compared),
        bias_m=float(d.mean()),
        rmse_m=float(np.sqrt(np.mean(d**2))),
        worst_m=float(d[worst]),
        worst_point=str(shots.point[compared[worst]]),
        reduced_chi_square=float(np.mean(z**2)),
        horizontal_rmse_m=float(np.sqrt(np.mean(away))),
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
