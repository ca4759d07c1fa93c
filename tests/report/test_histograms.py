"""Histograms against counting by hand, SciPy's normal, and what is known to have been drawn."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from pipeline.report import histograms, measured, render
from pipeline.report.units import units_of
from pipeline.report.words import Words
from tests.report.conftest import made_up_inputs
from tests.report.pages import PageReader

MILLIMETRES = units_of("m", 1.0)
FEET = units_of("us_survey_foot", 1200 / 3937)


def with_z(z, result="compared"):
    inputs = made_up_inputs()
    n = len(z)
    checks = {name: np.resize(values, n) for name, values in inputs.tables["checks"].items()}
    checks |= {"z": np.asarray(z, float), "result": np.full(n, result, object)}
    return dataclasses.replace(inputs, tables={**inputs.tables, "checks": checks})


def test_shots_are_counted_by_sigma_and_the_ends_hold_all_beyond():
    found = histograms.check_residuals(with_z([-9.0, -3.5, -0.5, 0.0, 0.99, 1.0, 4.0, 77.0]))
    assert found.edges.tolist() == [-4, -3, -2, -1, 0, 1, 2, 3, 4]
    assert found.count.tolist() == [2, 0, 0, 1, 2, 1, 0, 2]


def test_the_expected_shots_are_those_of_a_normal():
    found = histograms.check_residuals(with_z(np.zeros(50)))
    inner = 50 * np.diff(stats.norm.cdf([-3, -2, -1, 0, 1, 2, 3]))
    assert found.expected[1:-1] == pytest.approx(inner, abs=1e-9)
    assert found.expected[[0, -1]] == pytest.approx(50 * stats.norm.sf(3), abs=1e-9)
    assert found.expected.sum() == pytest.approx(50)


def test_drawn_shots_follow_the_line():
    found = histograms.check_residuals(with_z(np.random.default_rng(5).normal(size=4000)))
    assert found.edges[1] - found.edges[0] == 0.5
    chi_square = np.sum((found.count - found.expected) ** 2 / found.expected)
    assert chi_square < stats.chi2.ppf(0.999, len(found.count) - 1)


def test_shots_that_were_not_compared_do_not_count():
    assert histograms.check_residuals(with_z([0.1, 0.2], "used in calibration")) is None
    assert histograms.check_residuals(with_z([np.nan, np.nan])) is None
    mixed = with_z([0.1, 0.2, 0.3])
    mixed.tables["checks"]["result"][1] = "outside the cut"
    assert histograms.check_residuals(mixed).count.sum() == 2


def grid_of(deviation, floor=None):
    deviation = np.asarray(deviation, float).reshape(1, -1)
    floor = np.ones(deviation.shape, bool) if floor is None else np.asarray(floor).reshape(1, -1)
    n = deviation.shape[1]
    return measured.Grid(0.05 * np.arange(n), np.zeros(1), {"deviation": deviation, "floor": floor})


def test_cells_fall_into_round_bins_that_reach_over_the_tolerance():
    inputs = made_up_inputs()  # 30 mm high, 50 mm low
    deviation = np.random.default_rng(1).normal(0.004, 0.006, 5000)
    found = histograms.cell_deviations(inputs, grid_of(deviation), MILLIMETRES)
    step = np.diff(found.edges)
    assert step == pytest.approx(2.0) and 0.0 in found.edges
    assert found.edges[0] <= -50 and found.edges[-1] >= 30
    counted = [
        np.sum((deviation >= a / 1000) & (deviation < b / 1000)) for a, b in zip(found.edges, found.edges[1:])
    ]
    assert found.count.tolist() == counted


def test_a_few_wild_cells_do_not_flatten_the_rest_and_are_not_lost():
    deviation = np.r_[np.random.default_rng(1).normal(0, 0.006, 9998), 3.0, -2.0]
    found = histograms.cell_deviations(made_up_inputs(), grid_of(deviation), MILLIMETRES)
    assert found.count.sum() == 10_000
    assert found.edges[0] > -60 and found.edges[-1] < 40
    assert found.count[0] == found.count[-1] == 1


def test_cells_beside_the_floor_and_gaps_do_not_count():
    grid = grid_of([0.01, np.nan, 0.02, 0.5], [True, True, True, False])
    assert histograms.cell_deviations(made_up_inputs(), grid, MILLIMETRES).count.sum() == 2
    assert histograms.cell_deviations(made_up_inputs(), grid_of([np.nan]), MILLIMETRES) is None


@pytest.mark.parametrize("deviation", [[0.0], [0.012] * 40, [5.0, -7.0]])
def test_any_cells_have_bins(deviation):
    found = histograms.cell_deviations(made_up_inputs(), grid_of(deviation), MILLIMETRES)
    assert found.count.sum() == len(deviation) and 2 <= len(found.count) <= 42
    assert np.all(np.diff(found.edges) > 0)


def test_a_site_in_feet_has_bins_of_feet():
    inputs = made_up_inputs("us_survey_foot")
    deviation = np.array([0.01, 0.02, -0.01])
    found = histograms.cell_deviations(inputs, grid_of(deviation), FEET)
    step = found.edges[1] - found.edges[0]
    assert step == pytest.approx(0.01)
    assert found.edges[0] <= -0.050 * 3937 / 1200 and found.edges[-1] >= 0.030 * 3937 / 1200
    at = np.searchsorted(found.edges, deviation * 3937 / 1200, side="right") - 1
    assert found.count[at].tolist() == [1, 1, 1]
    names = [row["bin"] for row in histograms.cell_deviations_table(found, FEET, Words())["rows"]]
    assert "0.00 to +0.01" in names and len(set(names)) == len(names)


def test_the_bins_on_the_page_are_those_of_the_tables():
    inputs = made_up_inputs()
    page = render(inputs)
    read = PageReader(page.html)
    z = inputs.tables["checks"]["z"]
    shown = {row[0]: int(row[1]) for row in read.tables["check_residuals"][1:]}
    assert shown["+1.0 to +2.0"] == np.sum((z >= 1) & (z < 2))
    assert sum(shown.values()) == np.isfinite(z).sum() == 8
    cells = inputs.tables["as_built"]
    on = np.isfinite(cells["deviation"])
    assert sum(int(row[1].replace("\u202f", "")) for row in read.tables["cell_deviations"][1:]) == on.sum()
