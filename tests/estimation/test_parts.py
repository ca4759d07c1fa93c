"""A log in parts against the log in one piece, and the compiled kernels against the residuals they square."""

import numpy as np
import pytest

from pipeline import threads
from pipeline.estimation import arrow, motion_kernels, parts, sweeps
from pipeline.estimation.linearised import pieces
from pipeline.estimation.marginals import marginals
from pipeline.estimation.normal import corner_lengths, cost_by_epoch, linearise, linearised_along
from pipeline.estimation.optimise import optimise
from pipeline.estimation.parts import bounds, part_of
from pipeline.estimation.problem import (
    LOST,
    Weights,
    first_residual,
    huber,
    keep_all,
    lengths,
    motion_residual,
)
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.geometry import se3
from tests.estimation import dense
from tests.estimation.simulator import DRIFTING, MACHINE, Options, draw
from tests.estimation.test_adjust import _problem

HUBER = 2.5


@pytest.fixture(scope="module", params=["potentiometer", "bucket marker", "both", "drift"])
def at(request):
    """A log with gross corners, away from its optimum, with some corners and readings left out."""
    options = Options(
        epochs=9,
        bucket_marker=request.param != "potentiometer",
        potentiometer=request.param != "bucket marker",
        outliers=0.1,
        machine=DRIFTING if request.param == "drift" else MACHINE,
    )
    problem = _problem(draw(3, options))
    rng = np.random.default_rng(4)
    E = len(problem.epochs.time_ns)
    values = problem.first.retract(
        [1e-3 * rng.standard_normal((E, v.size)) for v in problem.tie.variables],
        0.3 * rng.standard_normal(problem.statics.size),
    )
    all_ = keep_all(problem, HUBER)
    weights = Weights(
        HUBER,
        tuple(rng.random(a.shape) > 0.1 for a in all_.corners),
        tuple(rng.random(a.shape) > 0.1 for a in all_.sensors),
    )
    return problem, values, weights


def _dense(problem, values, weights, newton):
    """Normal matrix, gradient and cost, by one dense Jacobian of all whitened residuals."""
    E, p = len(problem.epochs.time_ns), problem.statics.size
    sizes = [problem.chain_size(c) for c in range(len(problem.chains))]
    starts = np.cumsum([0, *[E * b for b in sizes]])
    n = starts[-1] + p
    H, g, cost = np.zeros((n, n)), np.zeros(n), 0.0

    def column(variable, epoch):
        c, place = problem.place(variable)
        return starts[c] + epoch * sizes[c] + np.arange(place.start, place.stop)

    def add(epoch, r, J, alive, m, share):
        nonlocal cost
        for i, k in enumerate(epoch):
            row = np.zeros((r.shape[1], n))
            for v, J_v in J.variables.items():
                row[:, column(v, k)] += J_v[i]
            for s, J_s in J.statics.items():
                row[:, starts[-1] + problem.statics.columns[s]] += J_s[i]
            for j in range(r.shape[1] // m):
                if not alive[i, j]:
                    continue
                e, A = r[i, m * j : m * j + m], row[m * j : m * j + m]
                length = np.linalg.norm(e)
                if not np.isfinite(length):
                    cost += share[i] * HUBER * (LOST - 0.5 * HUBER)
                    continue
                far = length > HUBER
                cost += share[i] * (HUBER * (length - 0.5 * HUBER) if far else 0.5 * length**2)
                w = share[i] * (HUBER / length if far else 1.0)
                bend = np.eye(m) - np.outer(e, e) / length**2 if far and newton else np.eye(m)
                H[:] += w * A.T @ bend @ A
                g[:] += w * A.T @ e

    for group, alive in zip(problem.corners, weights.corners, strict=True):
        add(group.epoch, *corner_residuals(group, values, problem.statics), alive, 2, group.share)
    for readings, alive in zip(problem.sensors, weights.sensors, strict=True):
        r, J = sensor_residuals(readings, values, problem.statics)
        add(readings.epoch, r, J, alive, 1, np.ones(len(r)))
    for v in range(len(problem.tie.variables)):
        e, J_1, J_2 = motion_residual(problem, values, v)
        for k in range(E - 1):
            row = np.zeros((e.shape[1], n))
            row[:, column(v, k)], row[:, column(v, k + 1)] = J_1[k], J_2[k]
            H += row.T @ row
            g += row.T @ e[k]
        e_1, J = first_residual(problem, values, v)
        x = column(v, 0)
        H[np.ix_(x, x)] += J.T @ J
        g[x] += J.T @ e_1
        cost += 0.5 * np.sum(e**2) + 0.5 * e_1 @ e_1
    H[starts[-1] :, starts[-1] :] += np.eye(p)
    g[starts[-1] :] += values.z
    return H, g, cost + 0.5 * values.z @ values.z


@pytest.mark.parametrize("newton", [False, True])
def test_compiled_normal_equations_are_those_of_the_residuals(at, newton):
    problem, values, weights = at
    H, g, cost = _dense(problem, values, weights, newton)
    ours, ours_g, _ = dense.assemble(*linearise(problem, values, weights, newton))
    scale = np.sqrt(np.diagonal(H))
    assert np.abs((ours - H) / np.outer(scale, scale)).max() < 1e-11
    assert np.abs((ours_g - g) / scale).max() < 1e-9 * np.abs(g / scale).max()
    local, prior = cost_by_epoch(problem, values, weights)
    assert local.sum() + prior == pytest.approx(cost, rel=1e-12)


def test_compiled_lengths_are_those_of_the_residuals(at):
    problem, values, weights = at
    for group in problem.corners:
        expected = lengths(corner_residuals(group, values, problem.statics, jacobians=False)[0], 2)
        np.testing.assert_allclose(corner_lengths(problem, values, group), expected, rtol=1e-9)
    weight, _ = huber(expected, HUBER, weights.corners[-1])
    assert np.any((weight > 0) & (weight < 1))  # the loss is bent somewhere


@pytest.mark.parametrize("size", [1, 2, 5])
def test_a_log_in_parts_has_the_step_and_the_inverse_of_the_log_in_one_piece(at, size):
    """In parts of one epoch, of two, of five; damped as during the iterations."""
    problem, values, weights = at
    chains, C, g_z = linearise(problem, values, weights)
    E = len(problem.epochs.time_ns)
    damping = 1e-4 * np.arange(E)
    whole = arrow.solve(chains, C, g_z, damping)
    inverse = [arrow.selected_inverse(f) for f in whole.factors]
    border = arrow.border(whole)
    cut = [part_of(problem, values, weights, a, b) for a, b in bounds(problem, size)]
    plain = pieces(cut)

    def damped(i):
        piece = plain(i)
        return sweeps.Piece(piece.chains, piece.C, piece.g_z, piece.count, damping[cut[i].with_far_end])

    reduced = sweeps.reduce(damped, len(cut))
    np.testing.assert_allclose(reduced.S, whole.S, rtol=1e-8, atol=1e-9 * np.abs(whole.S).max())
    np.testing.assert_allclose(reduced.dz, whole.dz, rtol=1e-6, atol=1e-8 * np.abs(whole.dz).max())
    expected = -sum(float(np.sum(c.g * d)) for c, d in zip(chains, whole.dx, strict=True)) - g_z @ whole.dz
    assert sum(reduced.innovations) + reduced.pull == pytest.approx(expected, rel=1e-9)
    for i, dx in sweeps.steps(damped, reduced):
        for ours, other in zip(dx, whole.dx, strict=True):
            assert np.abs(ours - other[cut[i].with_far_end]).max() < 1e-8 * np.abs(other).max()
    for i, found in sweeps.inverses(damped, reduced):
        for ours, (Z, G), Y in zip(found, inverse, border, strict=True):
            sigma = np.sqrt(np.einsum("nii->ni", Z))[cut[i].with_far_end]
            error = (ours.Z - Z[cut[i].with_far_end]) / (sigma[:, :, None] * sigma[:, None, :])
            assert np.abs(error).max() < 1e-7
            np.testing.assert_allclose(ours.Y, Y[cut[i].with_far_end], atol=1e-7 * np.abs(Y).max())
            between = slice(cut[i].start, cut[i].start + len(ours.G))
            np.testing.assert_allclose(ours.G, G[between], atol=1e-7 * np.abs(G).max())


def test_a_log_adjusted_in_parts_ends_where_the_log_in_one_piece_does(monkeypatch):
    """Gross corners, damping, gates and all; in parts of seven epochs, and twice to the same bytes."""
    drawn = draw(6, Options(epochs=30, outliers=0.02))
    problem = _problem(drawn)
    whole = optimise(problem, HUBER, 50)
    monkeypatch.setattr(
        "pipeline.estimation.optimise.bounds", lambda problem, size=7: bounds(problem, size=size)
    )
    first, second = (optimise(problem, HUBER, 50) for _ in range(2))
    assert whole.converged and first.converged
    assert first.cost == pytest.approx(whole.cost, rel=1e-9)
    P_zz = marginals(problem, first.values, first.weights).P_zz
    assert np.abs((first.values.z - whole.values.z) / np.sqrt(np.diagonal(P_zz))).max() < 1e-3
    for a, b in zip(first.weights.corners, whole.weights.corners, strict=True):
        assert np.array_equal(a, b) and not a.all()
    assert first.values.z.tobytes() == second.values.z.tobytes()
    for a, b in zip(first.values.pose, second.values.pose, strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("newton", [False, True])
def test_a_border_along_a_step_is_the_whole_border_times_the_step(at, newton):
    problem, values, weights = at
    dz = 0.2 * np.random.default_rng(8).standard_normal(problem.statics.size)
    whole, _, _ = linearise(problem, values, weights, newton)
    for chain, ours in zip(whole, linearised_along(problem, values, weights, dz, newton), strict=True):
        right = chain.g + chain.B @ dz[chain.columns]
        np.testing.assert_allclose(ours.g, right, atol=1e-11 * np.abs(right).max())
        np.testing.assert_array_equal(ours.D, chain.D)
        np.testing.assert_array_equal(ours.A, chain.A)


def test_states_are_moved_as_the_exponential_says():
    rng = np.random.default_rng(2)
    angle = np.r_[0.0, 1e-12, 1e-6, 0.03, 0.0316, 0.0317, 0.1, 1.0, 3.0, np.pi, 4.0]
    axis = rng.standard_normal((len(angle), 3))
    axis *= (angle / np.linalg.norm(axis, axis=-1))[:, None]
    d = np.concatenate([rng.standard_normal((len(angle), 3)), axis, np.ones((len(angle), 6))], axis=-1)
    T = se3.exp(rng.standard_normal((len(angle), 6)))
    moved = np.empty_like(T)
    motion_kernels.retract(T, d, moved)
    np.testing.assert_allclose(moved, se3.retract(T, d[:, :6]), rtol=0, atol=3e-15)


@pytest.mark.parametrize("parts_of", [6, 9])
def test_the_optimum_has_the_same_bytes_on_one_core_and_on_two(at, parts_of, monkeypatch):
    problem, _, _ = at
    monkeypatch.setattr(parts.bounds, "__defaults__", (parts_of,))
    monkeypatch.setattr("pipeline.estimation.gauss_newton.KEPT_PARTS", 1)
    found = []
    for cores in (1, 2, 3):
        monkeypatch.setattr(threads, "cores", lambda cores=cores: cores)
        optimum = optimise(problem, HUBER, 60)
        m = marginals(problem, optimum.values, optimum.weights)
        found.append([*optimum.values.pose, *optimum.values.rate, optimum.values.z, *m.Z, *m.Y, m.P_zz])
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert a.tobytes() == b.tobytes()
