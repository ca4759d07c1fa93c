"""The block algebra against dense matrices, and the compiled kernels against LAPACK's band routines."""

import numpy as np
import pytest
import scipy.linalg

from pipeline.estimation import arrow
from tests.estimation import dense


def _chains(seed, sizes=((7, 12), (7, 2), (7, 14)), p=9):
    """Random well-posed arrow with chains of different block sizes."""
    rng = np.random.default_rng(seed)
    C = 5 * np.eye(p)
    chains = []
    for E, b in sizes:
        J = rng.standard_normal((E, 2 * b, b))
        D = np.swapaxes(J, -1, -2) @ J + 0.1 * np.eye(b)
        A = np.zeros((E - 1, b, b))
        for k in range(E - 1):
            J_1, J_2 = rng.standard_normal((2, b, b))
            D[k] += J_1.T @ J_1
            D[k + 1] += J_2.T @ J_2
            A[k] = J_1.T @ J_2
        columns = np.sort(rng.choice(p, 5, replace=False))
        B = np.zeros((E, b, 5))
        J_x, J_z = rng.standard_normal((E, 8, b)), rng.standard_normal((E, 8, 5))
        D += np.swapaxes(J_x, -1, -2) @ J_x
        B += np.swapaxes(J_x, -1, -2) @ J_z
        C[np.ix_(columns, columns)] += np.einsum("eki,ekj->ij", J_z, J_z)
        chains.append(arrow.Chain(D, A, rng.standard_normal((E, b)), B, columns))
    return chains, C, rng.standard_normal(p)


def test_the_step_solves_the_dense_system():
    chains, C, g_z = _chains(0)
    H, g, starts = dense.assemble(chains, C, g_z)
    expected = -np.linalg.solve(H, g)
    step = arrow.solve(chains, C, g_z)
    for dx, a, b in zip(step.dx, starts, starts[1:], strict=False):
        np.testing.assert_allclose(dx.ravel(), expected[a:b], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(step.dz, expected[starts[-1] :], rtol=1e-9, atol=1e-11)


def test_other_right_hand_sides_are_solved_with_the_same_factors():
    chains, C, g_z = _chains(2)
    H, g, starts = dense.assemble(chains, C, g_z)
    rng = np.random.default_rng(5)
    rhs = rng.standard_normal((len(g), 3))
    expected = np.linalg.solve(H, rhs)
    parts = [rhs[a:b].reshape(*c.g.shape, 3) for c, a, b in zip(chains, starts, starts[1:], strict=False)]
    dx, dz = arrow.solve_again(arrow.solve(chains, C, g_z), chains, parts, rhs[starts[-1] :])
    for x, a, b in zip(dx, starts, starts[1:], strict=False):
        np.testing.assert_allclose(x.reshape(b - a, 3), expected[a:b], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(dz, expected[starts[-1] :], rtol=1e-9, atol=1e-11)


def test_marginals_are_blocks_of_the_dense_inverse():
    chains, C, g_z = _chains(1)
    H, _, starts = dense.assemble(chains, C, g_z)
    P = dense.inverse(H)
    step = arrow.solve(chains, C, g_z)
    P_zz = np.linalg.inv(step.S)
    sigma = np.sqrt(np.diagonal(P))
    n = starts[-1]
    for chain, factor, Y, start in zip(chains, step.factors, arrow.border(step), starts, strict=False):
        Z, G = arrow.selected_inverse(factor)
        E, b = chain.g.shape
        P_qq = P_zz[np.ix_(chain.columns, chain.columns)]
        for k in range(E):
            at = slice(start + k * b, start + (k + 1) * b)
            whole = Z[k] + Y[k] @ P_qq @ Y[k].T
            assert np.abs((whole - P[at, at]) / np.outer(sigma[at], sigma[at])).max() < 1e-10
            cross = -Y[k] @ P_zz[chain.columns]
            assert np.abs((cross - P[at, n:]) / np.outer(sigma[at], sigma[n:])).max() < 1e-10
            if k + 1 < E:
                after = slice(at.stop, at.stop + b)
                whole = -G[k] @ Z[k + 1] + Y[k] @ P_qq @ Y[k + 1].T
                assert np.abs((whole - P[at, after]) / np.outer(sigma[at], sigma[after])).max() < 1e-10
    np.testing.assert_allclose(P_zz, P[n:, n:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("b", [2, 12, 26])
def test_kernels_agree_with_the_band_routines_of_lapack(b):
    chains, _, _ = _chains(2, sizes=((40, b),))
    chain = chains[0]
    E, u = len(chain.D), 2 * b - 1
    band = np.zeros((u + 1, E * b))
    for r in range(b):
        for c in range(b):
            if c >= r:
                band[u + r - c, c::b] = chain.D[:, r, c]
            band[u + r - b - c, b + c :: b] = chain.A[:, r, c]
    expected = scipy.linalg.solveh_banded(band, chain.B.reshape(E * b, -1))
    factor = arrow.factor(chain.D, chain.A)
    np.testing.assert_allclose(
        factor.backward(factor.forward(chain.B)).reshape(E * b, -1), expected, rtol=1e-8, atol=1e-12
    )


def test_a_matrix_that_nothing_holds_is_refused_with_its_epoch():
    chains, C, g_z = _chains(3)
    chains[1].D[4] = -np.eye(2)
    with pytest.raises(np.linalg.LinAlgError, match="block 4"):
        arrow.solve(chains, C, g_z)
