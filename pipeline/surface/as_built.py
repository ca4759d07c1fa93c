"""The as-built surface: what is under each cell of the trench, how sure that is, and what is not known.

The rule, printed on the report:

* The ground is at or below where the edge has been. A cell's floor is the lowest pass over its centre (or the last
  one, for placed material), freed of the bias of taking the lowest of several noisy passes.
* Only sweeps between epochs that were *seen* count; a bridged stretch touches nothing.
* A cell is **cut** when its lowest pass came within `contact_m` of the design, or below it. Higher up the
  edge may have been in the air, or on ground that is still to be dug: **passed over**.
* A cell is also **passed over** when more than half of the crossed cells around it (within `around_m`) lie more than
  `step_m` lower, seen relative to the design: the edge flew over a hole there, or a ridge was left. A ramp stays cut,
  because on a ramp no more than half of the neighbours are lower.
* Beside the floor a pass more than `contact_m` below the designed slope counts only down at the floor's own level:
  designed slopes do not end where the ground does, and above it the edge is in the air.
* **Never touched**: no pass over its centre at any height. It is a gap and is shown as one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.errors import SurfaceError
from pipeline.surface.alignment import Alignment
from pipeline.surface.design import Design
from pipeline.surface.lowest_pass import Floor, last_floor, lowest_floor
from pipeline.surface.sweep import CellGrid, EdgePath, SweepSettings, path_along, sweep
from pipeline.tracks.poses import CuttingEdge

CUT, PASSED_OVER, NEVER = "cut", "passed over", "never touched"
MAX_CELLS = 40_000_000


@dataclass(frozen=True)
class SurfaceRule:
    """What counts as cut; the knobs of the rule above."""

    surface: str = "lowest"
    """`lowest` or `last` pass."""
    contact_m: float = 0.30
    """Above the design. A trench that still lacks more than this is not finished, and a swinging bucket clears it."""
    step_m: float = 0.10
    """Ridges left between two bucket widths are lower, flights over a dug hole higher."""
    around_m: float = 0.15
    side_m: float = 3.0
    """How far beside the floor cells are kept, for side slopes and over-dug width."""
    corrected: bool = True
    """False leaves the bias of the lowest pass in: for comparison only."""
    sweep: SweepSettings = field(default_factory=SweepSettings)

    def sentence(self) -> str:
        """The rule in words, for the report."""
        chosen = (
            "the lowest pass of the cutting edge over the cell's centre, freed of the bias of taking the lowest of "
            "several noisy passes"
            if self.surface == "lowest"
            else "the last pass of the cutting edge over the cell's centre"
        )
        return (
            f"As-built is {chosen}; the ground is at or below it. A cell is cut when that pass came within "
            f"{self.contact_m * 1000:.0f} mm of the design or below it, and is not more than "
            f"{self.step_m * 1000:.0f} mm above most of the crossed cells within {self.around_m * 1000:.0f} mm; "
            "otherwise it is passed over. Stretches in which the edge was not seen touch nothing."
        )


@dataclass(frozen=True)
class AsBuilt:
    """Cells of the as-built surface, row by row along the alignment; arrays (rows, columns) unless said otherwise."""

    grid: CellGrid
    state: np.ndarray
    """uint8: 0 never touched, 1 passed over, 2 cut."""
    floor: np.ndarray
    """bool: the cell belongs to the design's floor."""
    h: np.ndarray
    """As-built elevation, metres; nan unless cut."""
    h_lowest: np.ndarray
    """Lowest pass as it was estimated, metres; nan where never touched."""
    design_h: np.ndarray
    """Design elevation; nan outside the design."""
    sigma_own: np.ndarray
    """Own part of the standard deviation of `h`, metres; nan unless cut."""
    sigma_common: np.ndarray
    """Common part."""
    sigma_pass: np.ndarray
    """Own part of the pass that is the lowest, metres; nan unless cut. Several passes are surer than it."""
    passes: np.ndarray
    """int32: passes at any height."""
    lowest_time_ns: np.ndarray
    """int64: when the pass that counts was; 0 where never touched."""
    excess_m: np.ndarray
    """(j,) heights of the other passes above the floor; see `lowest_pass`."""
    excess_share: np.ndarray
    """(j,) share of passes at each."""

    @property
    def cut(self) -> np.ndarray:
        """(rows, columns) bool."""
        return self.state == 2

    @property
    def deviation(self) -> np.ndarray:
        """(rows, columns) as-built minus design, metres; nan unless cut and inside the design."""
        return self.h - self.design_h


STATE_NAMES = np.array([NEVER, PASSED_OVER, CUT], dtype=object)


def as_built(
    edge: CuttingEdge,
    alignment: Alignment,
    design: Design,
    cell_m: float,
    rule: SurfaceRule | None = None,
    path: EdgePath | None = None,
) -> AsBuilt:
    """The as-built surface of a trench.

    Parameters
    ----------
    edge : CuttingEdge
        The whole log, grid metres.
    alignment : Alignment
        The axis of the trench.
    design : Design
        What was to be dug.
    cell_m : float
        Side of a cell.
    rule : SurfaceRule, optional
        What counts as cut.
    path : EdgePath, optional
        The edge along the alignment, where the caller has it already (`path_along`).

    Raises
    ------
    SurfaceError
        The edge never was over the alignment, or the grid would be too large.
    """
    rule = rule or SurfaceRule()
    path = path_along(edge, alignment, rule.sweep) if path is None else path
    grid = grid_around(path, edge, alignment, design, cell_m, rule)
    station, offset = np.meshgrid(grid.station, grid.offset, indexing="ij")
    design_h = design.elevation(station, offset)
    floor = design.is_floor(station, offset)
    level = design.floor_level(grid.station)[:, None]
    # Beside the design, a vertical wall say, the floor's own level tells what is low enough to be in the soil.
    reference = np.where(np.isnan(design_h), level, design_h)
    passes = sweep(path, grid, reference + rule.contact_m, rule.sweep)
    chosen: Floor
    if rule.surface == "last":
        chosen = last_floor(passes.first, passes.height, passes.sigma_own)
    else:
        chosen = lowest_floor(passes.first, passes.height, passes.sigma_own, rule.corrected, passes.time_ns)
    shape = (grid.rows, grid.columns)
    h = chosen.height.reshape(shape)
    kept = np.isfinite(h)
    # A profile's side slopes go on upwards for ever; what is far below one of them and above the floor is the open
    # ground beside the trench, which the edge may have crossed in the air.
    beside = ~floor & (h < design_h - rule.contact_m) & (h > level + rule.contact_m)
    flown = beside | _lower_around(h - reference, rule.step_m, max(1, round(rule.around_m / cell_m)))
    cut = kept & ~flown
    state = np.where(cut, 2, np.where(passes.crossed.reshape(shape) > 0, 1, 0)).astype(np.uint8)
    of_pass = np.maximum(chosen.lowest_pass, 0)
    no_pass = len(passes.height) == 0
    common = np.full(grid.size, np.nan) if no_pass else passes.sigma_common[of_pass]
    of_one = np.full(grid.size, np.nan) if no_pass else passes.sigma_own[of_pass]
    when = np.zeros(grid.size, np.int64) if no_pass else passes.time_ns[of_pass]
    lowest = np.where(np.isfinite(passes.lowest), passes.lowest, np.nan)
    return AsBuilt(
        grid=grid,
        state=state,
        floor=floor,
        h=np.where(cut, h, np.nan),
        h_lowest=np.where(kept, chosen.lowest.reshape(shape), lowest.reshape(shape)),
        design_h=design_h,
        sigma_own=np.where(cut, chosen.sigma_own.reshape(shape), np.nan),
        sigma_common=np.where(cut, common.reshape(shape), np.nan),
        sigma_pass=np.where(cut, of_one.reshape(shape), np.nan),
        passes=passes.crossed.reshape(shape),
        lowest_time_ns=np.where(
            kept, when.reshape(shape), np.where(state > 0, passes.lowest_time_ns.reshape(shape), 0)
        ),
        excess_m=chosen.excess_m,
        excess_share=chosen.excess_share,
    )


@dataclass(frozen=True)
class Reach:
    """How far the trench was dug; metres."""

    first: float
    """Station at which the first row of cells was cut over half its floor or more; nan without such a row."""
    last: float
    dug: float
    """Length that was dug in all."""
    gaps: tuple[tuple[float, float], ...]
    """Stretches between first and last that were not."""
    sigma: float
    """Standard deviation of either end: the rounding to whole cells."""


def reach_of(built: AsBuilt) -> Reach:
    """The chainage that was reached: rows of cells of which half the floor or more was cut."""
    floor = built.floor & np.isfinite(built.design_h)
    cut = np.count_nonzero(floor & built.cut, axis=1)
    dug = (2 * cut >= np.count_nonzero(floor, axis=1)) & (cut > 0)
    grid = built.grid
    rows = np.flatnonzero(dug)
    sigma = grid.cell_m / float(np.sqrt(12.0))
    if not len(rows):
        return Reach(np.nan, np.nan, 0.0, (), sigma)
    border = grid.first_station + grid.cell_m * np.arange(grid.rows + 1)
    holes = np.flatnonzero(np.diff(rows) > 1)
    gaps = tuple((float(border[rows[k] + 1]), float(border[rows[k + 1]])) for k in holes)
    return Reach(
        float(border[rows[0]]), float(border[rows[-1] + 1]), float(len(rows) * grid.cell_m), gaps, sigma
    )


def grid_around(
    path: EdgePath, edge: CuttingEdge, alignment: Alignment, design: Design, cell_m: float, rule: SurfaceRule
) -> CellGrid:
    """Cells over the stretch of the design that the edge visited.

    Raises
    ------
    SurfaceError
        The edge never was over the alignment (says how near it came), or the cells would be too many.
    """
    first, last = design.station_range()
    first, last = max(first, alignment.start_station), min(last, alignment.end_station)
    reach = design.floor_reach() + rule.side_m
    swept = np.append(path.swept, False) | np.append(False, path.swept)
    station, offset = path.soh[swept, :, 0], path.soh[swept, :, 1]
    over = (station >= first) & (station <= last) & (np.abs(offset) <= reach)
    if not np.any(over):
        raise SurfaceError(_never_over(edge, alignment, (first, last), station.size > 0))
    # Snapped outward to whole cells counted from station and offset zero: runs of one site share their cells.
    margin = 0.5
    rows = _snapped(max(first, station[over].min() - margin), min(last, station[over].max() + margin), cell_m)
    columns = _snapped(
        max(-reach, offset[over].min() - margin), min(reach, offset[over].max() + margin), cell_m
    )
    # The floor is shown whole wherever there is some of it: a gap must be seen as a gap.
    floor = design.floor_reach()
    if floor < 50.0:
        whole = _snapped(-floor, floor, cell_m)
        columns = (min(columns[0], whole[0]), max(columns[1], whole[1]))
    count = (rows[1] - rows[0]) * (columns[1] - columns[0])
    if count > MAX_CELLS:
        raise SurfaceError(
            f"the as-built surface would have {count / 1e6:.0f} million cells of {cell_m * 1000:.0f} mm, at most "
            f"{MAX_CELLS / 1e6:.0f} million are kept; raise survey.cell_m in site.toml"
        )
    return CellGrid(cell_m, rows[0] * cell_m, columns[0] * cell_m, rows[1] - rows[0], columns[1] - columns[0])


def _snapped(low: float, high: float, cell_m: float) -> tuple[int, int]:
    first = int(np.floor(low / cell_m + 1e-6))
    return first, max(first + 1, int(np.ceil(high / cell_m - 1e-6)))


def _never_over(
    edge: CuttingEdge, alignment: Alignment, stretch: tuple[float, float], any_swept: bool
) -> str:
    if not any_swept:
        return (
            f"the cutting edge was never seen for two epochs in a row ({len(edge)} epochs, "
            f"{int(np.count_nonzero(edge.seen))} of them seen); see the coverage of the tags"
        )
    middle = edge.p_grid[edge.seen, 1]
    station, offset = alignment.station_offset(middle[:, :2])
    nearest = np.hypot(station - np.clip(station, *stretch), offset)
    k = int(np.argmin(nearest))
    return (
        f"the machine never worked over the alignment: the cutting edge came no nearer than {nearest[k]:.1f} m to its "
        f"designed stretch (station {stretch[0]:.2f} to {stretch[1]:.2f} m), at E {middle[k, 0]:.2f} "
        f"N {middle[k, 1]:.2f} m; check the alignment, the benchmarks and grid.origin in site.toml"
    )


def _lower_around(deviation: np.ndarray, step: float, reach: int) -> np.ndarray:
    """Whether more than half of the known cells around a cell lie more than `step` lower."""
    known = np.isfinite(deviation)
    value = np.where(known, deviation, np.inf)
    there, lower = np.zeros(deviation.shape, np.int16), np.zeros(deviation.shape, np.int16)
    rows, columns = deviation.shape
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            if i == j == 0 or abs(i) >= rows or abs(j) >= columns:
                continue
            here = (slice(max(0, -i), rows - max(0, i)), slice(max(0, -j), columns - max(0, j)))
            other = (slice(max(0, i), rows - max(0, -i)), slice(max(0, j), columns - max(0, -j)))
            there[here] += known[other]
            lower[here] += value[other] < value[here] - step
    return known & (2 * lower > there)
