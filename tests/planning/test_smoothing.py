"""The steady state of smoothing against a spectrum, against a dense solve, and between looks."""

import numpy as np
import pytest

from pipeline.planning.smoothing import smoothed

Q = np.repeat([0.045, 0.01], 3)
V = np.repeat([4e-6, 2.7e-6], 3)
DT = 0.2


def information(seed=0):
    A = np.random.default_rng(seed).normal(size=(8, 6)) * [300, 300, 300, 2e3, 2e3, 2e3]
    return A.T @ A


def by_spectrum(H, dt, q, v):
    """1/(2 pi) integral of (H + S^-1)^-1, S the spectrum of integrated white noise, sampled."""
    x, weight = np.polynomial.legendre.leggauss(300)
    x, weight = 0.5 * (x + 1), 0.5 * weight
    out = np.zeros_like(H)
    for w, dw in zip(np.pi * x**4, 4 * weight * x**3, strict=True):
        rise = 4 * np.sin(w / 2) ** 2
        S = q * dt**3 * (2 + np.cos(w)) / (3 * rise**2) + v * dt / rise
        out += dw * np.linalg.inv(H + np.diag(1 / S))
    return out


def by_dense_solve(H, dt, q, v, share, looks=41):
    """One long stretch of looks with an instant put between two of them, all states in one matrix."""
    b = len(H)
    times = np.arange(looks, dtype=float)
    middle = looks // 2
    times = np.insert(times, middle + 1, middle + share) if share else times
    at = middle + 1 if share else middle
    n = len(times)
    N = 1e-9 * np.eye(2 * b * n)
    for k in range(n):
        if not share or k != at:
            part = slice(2 * b * k, 2 * b * k + b)
            N[part, part] += H
    for k, step in enumerate(np.diff(times) * dt):
        F = np.block([[np.eye(b), step * np.eye(b)], [np.zeros((b, b)), np.eye(b)]])
        cov = np.block([[np.diag(q * step**3 / 3 + v * step), np.diag(q * step**2 / 2)],
                        [np.diag(q * step**2 / 2), np.diag(q * step)]])  # fmt: skip
        J = np.zeros((2 * b, 2 * b * n))
        J[:, 2 * b * k : 2 * b * (k + 1)], J[:, 2 * b * (k + 1) : 2 * b * (k + 2)] = -F, np.eye(2 * b)
        N += J.T @ np.linalg.solve(cov, J)
    return np.linalg.inv(N)[2 * b * at : 2 * b * at + b, 2 * b * at : 2 * b * at + b]


@pytest.mark.parametrize("shake", [np.zeros(6), V])
def test_at_the_looks_it_is_the_two_sided_filter_of_the_spectrum(shake):
    H = information()
    assert smoothed(H[None], DT, Q, shake)[0] == pytest.approx(
        by_spectrum(H, DT, Q, shake), rel=1e-6, abs=1e-12
    )


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.75])
def test_between_the_looks_it_is_the_dense_solve(share):
    H = information(1)
    ours, other = smoothed(H[None], DT, Q, V, (share,))[0], by_dense_solve(H, DT, Q, V, share)
    scale = np.sqrt(np.outer(np.diagonal(other), np.diagonal(other)))
    assert np.abs((ours - other) / scale).max() < 1e-4


def test_a_scalar_in_continuous_time_is_wieners_formula():
    r, q, dt = 1e-4, 1e-3, 1e-3  # many looks within a correlation time
    density = r * dt
    expected = density**0.75 * q**0.25 / (2 * np.sqrt(2))
    assert smoothed(np.array([[[1 / r]]]), dt, [q])[0, 0, 0] == pytest.approx(expected, rel=1e-3)


def test_a_lively_body_keeps_the_sigma_of_one_look():
    H = information(2)
    lively = smoothed(H[None], DT, 1e6 * np.ones(6))[0]
    assert lively == pytest.approx(np.linalg.inv(H), rel=1e-3, abs=1e-12)
