"""The problem that GTSAM, SciPy and we are compared on is one and the same, down to its covariances."""

import numpy as np
import pytest

from benchmarks import _gtsam, _scipy, solvers
from benchmarks._two_carriers import problem_of_two


@pytest.fixture(scope="module")
def problem():
    return problem_of_two(40)


def test_gtsam_and_we_have_one_function_one_optimum_and_one_covariance(problem):
    """GTSAM's factors and ours: cost at the start and at both answers, covariances at GTSAM's answer."""
    gtsam = pytest.importorskip("gtsam")
    graph = _gtsam.Graph(problem)
    start = solvers.our_cost(problem, problem.first)
    assert graph.factors.error(graph.start) == pytest.approx(start, rel=1e-10)
    settings, ordering = gtsam.GaussNewtonParams(), graph.ordering()
    settings.setOrdering(ordering)
    settings.setRelativeErrorTol(1e-9)
    found = gtsam.GaussNewtonOptimizer(graph.factors, graph.start, settings).optimize()
    values, (ours, _) = graph.values(found), solvers.plain_optimum(problem)
    cost = solvers.our_cost(problem, ours)
    for other in (
        solvers.our_cost(problem, values),
        graph.factors.error(graph.of_ours(values)),
        graph.factors.error(graph.of_ours(ours)),
    ):
        assert other == pytest.approx(cost, rel=1e-9)
    P = _gtsam.covariances(graph.factors.linearize(found), ordering, graph.all_keys())
    worst = solvers.covariance_difference(problem, values, graph, P)
    print(
        f"cost {start:.0f} at the start, {cost:.6f} at the end; covariances off by {worst:.1e} of their sigmas"
    )
    assert len(P) == 4 * 40 + 6
    assert worst < 1e-8


def test_the_jacobian_for_scipy_is_that_of_differences(problem):
    sparse = _scipy.Sparse(problem)
    rng = np.random.default_rng(0)
    x, way = 1e-3 * rng.standard_normal(sparse.size), rng.standard_normal(sparse.size)
    expected = (sparse.residuals(x + 1e-6 * way) - sparse.residuals(x - 1e-6 * way)) / 2e-6
    assert np.abs(sparse.jacobian(x) @ way - expected).max() < 1e-8 * np.abs(expected).max()
    cost = 0.5 * np.sum(sparse.residuals(np.zeros(sparse.size)) ** 2)
    assert cost == pytest.approx(solvers.our_cost(problem, problem.first), rel=1e-12)


def test_a_slow_way_and_a_wrong_cost_miss_their_bars():
    def row(epochs, way, seconds=1.0, cost=100.0):
        return solvers.Row(epochs, way, 4, seconds, seconds, 300.0, cost)

    good = [row(n, "ours") for n in solvers.LENGTHS] + [row(n, "gtsam", 6.0) for n in solvers.LENGTHS[:2]]
    cut = solvers.Row(100_000, "gtsam", ended="stopped after 600 s of the processor")
    assert solvers.described(cut, good[2]).endswith(cut.ended)
    assert solvers.missed_bars([*good, cut]) == []
    assert "only 4.0 times faster" in solvers.missed_bars([*good[:4], row(10_000, "gtsam", 4.0), cut])[0]
    assert "off by" in solvers.missed_bars([*good, row(100_000, "gtsam", 99.0, 100.0001)])[0]
    assert "finishes too" in solvers.missed_bars([*good, row(100_000, "gtsam", 4.0)])[0]
    assert solvers.missed_bars([*good, row(100_000, "gtsam", 99.0)]) == []
