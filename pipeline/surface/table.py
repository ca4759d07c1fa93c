"""The columns of the tables that the survey writes."""

from __future__ import annotations

import numpy as np

from pipeline.surface.alignment import Alignment
from pipeline.surface.approach import Instants
from pipeline.surface.as_built import STATE_NAMES, AsBuilt
from pipeline.surface.checks import Comparison
from pipeline.surface.decision import SideVerdicts, Stations
from pipeline.surface.shots import Shots
from pipeline.surface.sides import SIDES, Sides
from pipeline.surface.station_budget import StationBudget
from pipeline.surface.utilities import Finding, verdict_of
from pipeline.surface.volumes import Volumes

Columns = dict[str, np.ndarray]


def columns_of_as_built(built: AsBuilt, null_int: int) -> Columns:
    """Columns of the ``as_built`` table: the cells of the designed floor and all others that were cut."""
    rows, columns = np.nonzero(built.floor | built.cut)
    at = (rows, columns)
    state = built.state[at]
    return {
        "station": built.grid.station[rows],
        "offset": built.grid.offset[columns],
        "state": STATE_NAMES[state],
        "h": built.h[at],
        "h_lowest": built.h_lowest[at],
        "design_h": built.design_h[at],
        "deviation": built.deviation[at],
        "sigma_own": built.sigma_own[at],
        "sigma_common": built.sigma_common[at],
        "passes": built.passes[at],
        "lowest_time_ns": np.where(state > 0, built.lowest_time_ns[at], null_int),
    }


def columns_of_stations(stations: Stations) -> Columns:
    """Columns of the ``stations`` table."""
    return {name: getattr(stations, name) for name in Stations.__dataclass_fields__}


def columns_of_sides(sides: Sides, judged: SideVerdicts | None) -> Columns:
    """Columns of the ``sides`` table: station by station, left before right; without a tolerance nothing is judged."""
    shape = sides.outward.shape
    said = {
        "expanded_uncertainty": np.full(shape, np.nan) if judged is None else judged.expanded_uncertainty,
        "verdict": np.full(shape, "", object) if judged is None else judged.verdict,
        "reason": np.full(shape, "", object) if judged is None else judged.reason,
    }
    found = {
        name: getattr(sides, name)
        for name in ("outward", "sigma_own", "sigma_common", "slope", "sigma_slope")
    }
    return {
        "station": np.repeat(sides.station, 2),
        "side": np.tile(np.array(SIDES, object), len(sides.station)),
        "width": np.repeat(sides.width, 2),
        "sigma_width": np.repeat(np.hypot(sides.sigma_width_own, sides.sigma_width_common), 2),
        **{name: values.ravel() for name, values in (found | said).items()},
    }


def columns_of_station_budgets(budget: StationBudget) -> Columns:
    """Columns of the ``station_budgets`` table: the sources of each station that was reached."""
    told = np.flatnonzero(np.isfinite(budget.sigma).all(axis=1)) if budget.sources else np.zeros(0, np.int64)
    count = len(budget.sources)
    return {
        "station": np.repeat(budget.station[told], count),
        "source": np.tile(np.array(budget.sources, object), len(told)),
        "sigma": budget.sigma[told].ravel(),
    }


def columns_of_volumes(volumes: Volumes) -> Columns:
    """Columns of the ``volumes`` table: cut, left and over-dug of each station."""
    rows = [
        (station, volume)
        for station, of_station in zip(volumes.station, volumes.of_station)
        for volume in of_station
    ]
    return {
        "station": np.array([station for station, _ in rows], float),
        "kind": np.array([volume.kind for _, volume in rows], object),
        "volume": np.array([volume.m3 for _, volume in rows], float),
        "sigma_own": np.array([volume.sigma_own_m3 for _, volume in rows], float),
        "sigma_common": np.array([volume.sigma_common_m3 for _, volume in rows], float),
        "area": np.array([volume.area_m2 for _, volume in rows], float),
    }


def columns_of_checks(shots: Shots, comparison: Comparison) -> Columns:
    """Columns of the ``checks`` table."""
    whole = ("station", "offset", "as_built_h", "difference", "difference_e", "difference_n", "sigma_own")
    plan = {axis: comparison.own[:, i, i] + comparison.common[:, i, i] for i, axis in enumerate("en")}
    edge = shots.kind != "floor"
    return {
        "point": shots.point,
        "code": shots.code,
        "kind": shots.kind,
        "edge_point": comparison.edge_point,
        "time_ns": comparison.time_ns,
        "e": shots.p_grid[:, 0],
        "n": shots.p_grid[:, 1],
        "h": shots.p_grid[:, 2],
        **{
            name: getattr(comparison, name)
            for name in (*whole, "sigma_common", "sigma", "sigma_ts", "z", "result")
        },
        **{f"sigma_{axis}": np.where(edge, np.sqrt(variance), np.nan) for axis, variance in plan.items()},
    }


def columns_of_utilities(findings: list[Finding], alignment: Alignment) -> Columns:
    """Columns of the ``utilities`` table: of each utility the nearest instant of the log, then its approaches."""
    rows: list[dict[str, object]] = []
    for finding in findings:
        near = finding.approaches
        events = [_instant(near.events, i, finding, alignment) for i in range(len(near.start_ns))]
        for row, start, end in zip(events, near.start_ns, near.end_ns):
            row |= {"start_ns": start, "end_ns": end}
        if near.closest is not None:
            closest = _instant(near.closest, 0, finding, alignment)
            # As a rule it is the nearest instant of an approach that is listed anyway.
            same = next((row for row in events if row["time_ns"] == closest["time_ns"]), None)
            if same is None:
                rows.append(closest)
            else:
                events.remove(same)
                rows.append(same)
            rows[-1]["nearest"] = True
        rows += events
    return {name: np.array([row[name] for row in rows], kind) for name, kind in _UTILITY_COLUMNS.items()}


_UTILITY_COLUMNS = {
    "utility": object, "kind": object, "nearest": bool, "verdict": object, "start_ns": np.int64, "end_ns": np.int64,
    "time_ns": np.int64, "station": float, "offset": float, "e": float, "n": float, "h": float, "axis_e": float,
    "axis_n": float, "axis_h": float, "distance": float, "bound": float, "sigma_own": float, "sigma_common": float,
    "sigma_line": float,
}  # fmt: skip


def _instant(found: Instants, i: int, finding: Finding, alignment: Alignment) -> dict[str, object]:
    station, offset = alignment.station_offset(found.edge[i : i + 1, :2])
    distance, bound = float(found.distance[i]), float(found.bound[i])
    return {
        "utility": finding.utility.name,
        "kind": finding.utility.kind,
        "nearest": False,
        "verdict": verdict_of(distance, bound, finding.utility.line.clearance),
        "start_ns": found.time_ns[i],
        "end_ns": found.time_ns[i],
        "time_ns": found.time_ns[i],
        "station": station[0],
        "offset": offset[0],
        **dict(zip(("e", "n", "h"), found.edge[i])),
        **dict(zip(("axis_e", "axis_n", "axis_h"), found.axis[i])),
        "distance": distance,
        "bound": bound,
        "sigma_own": found.sigma_own[i],
        "sigma_common": found.sigma_common[i],
        "sigma_line": found.sigma_line[i],
    }
