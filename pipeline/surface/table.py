"""The columns of ``as_built``, ``stations`` and ``checks``."""

from __future__ import annotations

import numpy as np

from pipeline.surface.as_built import STATE_NAMES, AsBuilt
from pipeline.surface.checks import Comparison
from pipeline.surface.decision import Stations
from pipeline.surface.shots import Shots

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


def columns_of_checks(shots: Shots, comparison: Comparison) -> Columns:
    """Columns of the ``checks`` table."""
    return {
        "point": shots.point,
        "code": shots.code,
        "e": shots.p_grid[:, 0],
        "n": shots.p_grid[:, 1],
        "h": shots.p_grid[:, 2],
        **{name: getattr(comparison, name) for name in Comparison.__dataclass_fields__},
    }
