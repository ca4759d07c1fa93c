"""Where the common part of each station's sigma comes from, by the groups of the error budget.

The adjustment tells it of the cutting edge's elevation at each instant (`estimation.sensitivities`); a station rests on
the passes that are the lowest over its cells, so its budget is that of their instants. Where the edge rose or fell, an
error in plan is one of height too: what the station's common sigma has beyond the groups is told as that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.sensitivities import BUDGET, Sensitivities
from pipeline.surface.as_built import AsBuilt
from pipeline.surface.shot_errors import between

IN_PLAN = "errors in plan, where the edge rose or fell"


@dataclass(frozen=True)
class StationBudget:
    """Standard deviations by station and source."""

    station: np.ndarray
    """(n,) metres."""
    sources: tuple[str, ...]
    sigma: np.ndarray
    """(n, sources) root of the mean square over the cells that were cut, metres; nan where none was."""


def station_budget(
    built: AsBuilt, answer: Sensitivities | None, station: np.ndarray, step_m: float
) -> StationBudget:
    """The common error budget of each station.

    Parameters
    ----------
    built : AsBuilt
        Its floor cells that were cut count, at the times of their lowest passes.
    answer : Sensitivities or None
        Of the adjustment.
    station : (n,) array
        Metres, ascending: each stands for half a step to either side.
    step_m : float
        Their distance.
    """
    groups = () if answer is None else tuple(k for k, s in enumerate(answer.sources) if s.kind == BUDGET)
    names = () if answer is None else tuple(answer.sources[k].name for k in groups)
    if answer is None or not groups:
        return StationBudget(station, names, np.full((len(station), 0), np.nan))
    names = (*names, IN_PLAN)
    sigma = np.full((len(station), len(names)), np.nan)
    variance = answer.response[:, list(groups), 2].astype(np.float64) ** 2
    edges = np.searchsorted(
        built.grid.station, np.concatenate([station - 0.5 * step_m, station[-1:] + 0.5 * step_m])
    )
    for i in range(len(station)):
        rows = slice(edges[i], edges[i + 1])
        cut = built.cut[rows] & built.floor[rows]
        if not cut.any():
            continue
        before, share = between(answer.time_ns, built.lowest_time_ns[rows][cut])
        after = np.minimum(before + 1, len(answer.time_ns) - 1)
        at = (1.0 - share[:, None]) * variance[before] + share[:, None] * variance[after]
        whole = float(built.sigma_common[rows][cut].mean()) ** 2
        rest = max(whole - float(at.mean(axis=0).sum()), 0.0)
        sigma[i] = np.sqrt([*at.mean(axis=0), rest])
    return StationBudget(station, names, sigma)
