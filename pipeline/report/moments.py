"""When the floor of the worst stations was made: where to look in the log for why they are what they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

Table = Mapping[str, np.ndarray]

WORST = 3
WINDOW_NS = 2_000_000_000
"""One pass of the bucket crosses a station in a second or two."""


@dataclass(frozen=True)
class Moment:
    """The pass that made most of the floor of one station."""

    station: float
    """Metres, as are its deviation and its uncertainty."""
    deviation: float
    expanded_uncertainty: float
    verdict: str
    time_ns: int
    """When it came through, an instant of the table as_built."""
    cells: int
    """Cells of its floor whose lowest pass was within a second of it."""
    of_cells: int
    """Cells of its floor that were cut."""


def worst_rows(stations: Table, count: int = WORST) -> np.ndarray:
    """Rows of the worst stations, the worst first: those that fail before all others, by size of the deviation."""
    deviation = np.abs(np.asarray(stations["deviation"], float))
    known = np.flatnonzero(np.isfinite(deviation))
    fails = np.asarray(stations["verdict"])[known] == "FAIL"
    return known[np.lexsort((known, -deviation[known], ~fails))][:count]


def worst_moments(stations: Table, as_built: Table, floor: np.ndarray, step_m: float) -> list[Moment]:
    """The moment of each of the worst stations, the worst first; stations without a cut cell have none.

    Parameters
    ----------
    stations, as_built : tables
        Of the survey stage.
    floor : (n,) bool array
        Which cells belong to the design's floor: a verdict rests on these alone.
    step_m : float
        Length of a station.
    """
    along, when = np.asarray(as_built["station"], float), np.asarray(as_built["lowest_time_ns"], np.int64)
    cut = np.isfinite(np.asarray(as_built["deviation"], float)) & floor & (when > 0)
    found = []
    for row in worst_rows(stations):
        station = float(stations["station"][row])
        times = np.sort(when[cut & (np.abs(along - station) <= step_m / 2 + 1e-6)])
        if not len(times):
            continue
        # The two seconds that hold most of the cells; the median of several passes would be an instant of none.
        count = np.searchsorted(times, times + WINDOW_NS, side="right") - np.arange(len(times))
        first = int(np.argmax(count))
        pass_ns = int(times[first + (int(count[first]) - 1) // 2])
        near = int(np.count_nonzero(np.abs(times - pass_ns) <= WINDOW_NS // 2))
        found.append(
            Moment(
                station,
                deviation=float(stations["deviation"][row]),
                expanded_uncertainty=float(stations["expanded_uncertainty"][row]),
                verdict=str(stations["verdict"][row]),
                time_ns=pass_ns,
                cells=near,
                of_cells=len(times),
            )
        )
    return found
