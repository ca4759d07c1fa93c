"""Which stations are the worst, and which pass made their floor."""

import numpy as np
import pytest

from pipeline.report.moments import worst_moments, worst_rows

SECOND = 1_000_000_000
T0 = 1_790_000_000 * SECOND


def stations(deviation, verdict):
    n = len(deviation)
    return {
        "station": 100.25 + 0.5 * np.arange(n),
        "deviation": np.array(deviation, float),
        "expanded_uncertainty": np.full(n, 0.01),
        "verdict": np.array(verdict, object),
    }


def cells(rows):
    """(station, offset, time in seconds or None where it was not cut)."""
    return {
        "station": np.array([row[0] for row in rows], float),
        "offset": np.array([row[1] for row in rows], float),
        "deviation": np.array([np.nan if row[2] is None else 0.05 for row in rows]),
        "lowest_time_ns": np.array([0 if row[2] is None else T0 + round(row[2] * SECOND) for row in rows]),
    }


def test_what_fails_is_worse_than_what_is_only_further_off():
    # With 30 mm high and 80 mm low allowed, 40 mm high fails where 60 mm low passes.
    found = stations([-0.060, 0.035, np.nan, 0.040, 0.0], ["PASS", "FAIL", "NOT REACHED", "FAIL", "PASS"])
    assert worst_rows(found).tolist() == [3, 1, 0]


def test_of_equal_deviations_the_first_station_comes_first():
    assert worst_rows(stations([0.02, -0.02, 0.02, 0.02], ["PASS"] * 4)).tolist() == [0, 1, 2]


def test_nothing_dug_has_no_worst_station():
    found = stations([np.nan] * 3, ["NOT REACHED"] * 3)
    assert worst_rows(found).tolist() == []
    assert worst_moments(found, cells([(100.25, 0, None)]), np.ones(1, bool), 0.5) == []


def test_the_pass_that_made_most_cells_is_taken_and_not_the_time_between_two():
    """Seven cells by a pass at 10 s, five by one at 40 s: the median of all would be neither."""
    found = stations([0.05], ["FAIL"])
    early, late = 10 + 0.1 * np.arange(7), 40 + 0.1 * np.arange(5)
    rows = [(100.3, 0.05 * i, t) for i, t in enumerate([*early, *late])]
    (moment,) = worst_moments(found, cells(rows), np.ones(len(rows), bool), 0.5)
    assert (moment.time_ns - T0) / SECOND == pytest.approx(10.3)
    assert (moment.cells, moment.of_cells) == (7, 12)
    assert (moment.station, moment.verdict) == (100.25, "FAIL")


def test_only_cells_of_the_station_and_of_the_floor_count():
    found = stations([0.05, 0.0], ["FAIL", "PASS"])
    rows = [(100.1, 0, 5.0), (100.4, 0, 5.1), (100.45, 0.9, 77.0), (100.45, 0.9, 77.1), (100.45, 0.9, 77.2)]
    rows += [(100.6, 0, 90.0)] * 9 + [(100.3, 0, None)]
    floor = np.array([row[1] == 0 for row in rows])
    first, second = worst_moments(found, cells(rows), floor, 0.5)
    assert ((first.time_ns - T0) / SECOND, first.cells, first.of_cells) == (5.0, 2, 2)
    assert ((second.time_ns - T0) / SECOND, second.cells) == (90.0, 9)


@pytest.mark.parametrize("seed", range(5))
def test_the_busiest_two_seconds_are_those_of_a_search_of_all(seed):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.choice(np.arange(0, 60, 0.25), 80))
    rows = [(100.25, 0, t + 0.001) for t in times]
    (moment,) = worst_moments(stations([0.05], ["FAIL"]), cells(rows), np.ones(80, bool), 0.5)
    when = (moment.time_ns - T0) / SECOND - 0.001
    most = max(np.sum((times >= t) & (times <= t + 2)) for t in times)
    assert max(np.sum((times >= t) & (times <= t + 2)) for t in times if t <= when <= t + 2) == most
    assert moment.cells == np.sum(np.abs(times - when) <= 1)
