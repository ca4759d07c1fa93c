"""The common error budget of stations: that of the instants at which their lowest passes were."""

import numpy as np
import pytest

from pipeline.estimation.sensitivities import Sensitivities, Source
from pipeline.surface.as_built import as_built
from pipeline.surface.station_budget import IN_PLAN, station_budget

T0_NS = 1_750_000_000_000_000_000


def test_a_station_has_the_budget_of_the_passes_it_rests_on(trench):
    # Two halves, dug ten seconds apart: the benchmarks' part grows from 2 to 4 mm in between, the teeth's stays.
    t = np.concatenate([np.arange(0, 3, 0.05), 10 + np.arange(0, 3, 0.05)])
    station = np.concatenate([np.linspace(2.0, 4.8, 60), np.linspace(5.2, 8.0, 60)])
    edge = trench.edge(t, station, 0.0, 50.0, sigma=0.003, common=0.005)
    built = as_built(edge, trench.alignment, trench.design, 0.1)
    sources = (
        Source("wear", "", "", "m"),
        Source("budget", "benchmarks", "h", "sigma"),
        Source("budget", "cutting edge", "h", "sigma"),
    )
    response = np.zeros((3, 3, 6), np.float32)
    response[:, 0, 2] = -1.0
    response[:, 1, 2] = [0.002, 0.002, 0.004]
    response[:, 2, 2] = 0.001
    first = int(edge.time_ns[0])
    answer = Sensitivities(first + np.array([0, 4, 10]) * 10**9, sources, response)
    where = np.arange(0.5, 9.6, 0.5)
    budget = station_budget(built, answer, where, 0.5)
    assert budget.sources == ("benchmarks", "cutting edge", IN_PLAN)
    assert np.isnan(budget.sigma[[0, -1]]).all()
    np.testing.assert_allclose(budget.sigma[[6, 12], :2], [[0.002, 0.001], [0.004, 0.001]], rtol=1e-6)
    # With the rest they are the station's common sigma.
    np.testing.assert_allclose(np.sum(budget.sigma[[6, 12]] ** 2, axis=1), 0.005**2, rtol=1e-5)
    # Variances are what is interpolated: half-way between 2 and 4 mm they are 3.16.
    between = Sensitivities(first + np.array([0, 4, 17]) * 10**9, sources, response)
    rows = (built.grid.station >= where[12] - 0.25) & (built.grid.station < where[12] + 0.25)
    share = (built.lowest_time_ns[rows][built.cut[rows] & built.floor[rows]] - first) * 1e-9
    expected = np.sqrt(np.mean(4e-6 + 12e-6 * (share - 4) / 13))
    assert station_budget(built, between, where, 0.5).sigma[12, 0] == pytest.approx(expected, rel=1e-5)


def test_without_an_adjustment_there_is_no_budget(trench):
    built = as_built(trench.passes([50.0]), trench.alignment, trench.design, 0.1)
    assert station_budget(built, None, np.array([3.5]), 0.5).sources == ()
