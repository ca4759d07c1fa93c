"""Shots of a standing machine against a dense solve of the same problem, with derivatives by differences."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from pipeline.calibration import belt, held_points
from pipeline.calibration.belt import EdgeTouch
from pipeline.calibration.held_points import HeldPoint, _Prior
from pipeline.geometry import se3

UNKNOWNS, KNOWN_M = 5, 0.004
SECOND = 1_000_000_000


def spread(rng, n, scale):
    """A covariance (n, n) with correlations."""
    A = rng.normal(size=(n, n)) * scale
    return A @ A.T + 0.2 * scale**2 * np.eye(n)


def world(seed, shots=6, moved=None, known=1.0):
    """An adjustment of few unknowns, shots of an edge, and the residual of each as a function of pose, point and z."""
    rng = np.random.default_rng(seed)
    P = spread(rng, UNKNOWNS, 1.0) * known**2
    whole = SimpleNamespace(
        optimum=SimpleNamespace(values=SimpleNamespace(z=rng.normal(size=UNKNOWNS))),
        found=SimpleNamespace(P_zz=P),
    )
    held = []
    for k in range(shots):
        T = se3.exp(np.concatenate([rng.uniform(-5, 5, 3), rng.normal(size=3)]))
        own, M = spread(rng, 6, 1e-3), rng.normal(size=(6, UNKNOWNS)) * 1e-3
        p = se3.transform(T, np.array([0.5 if k % 2 else -0.5, 0.0, 0.0]) + rng.normal(size=3) * 2e-3)
        if k == moved:
            p = p + np.array([0.0, 0.0, 0.05])
        residual = belt._off_edge(0.5 if k % 2 else -0.5)
        held.append(
            HeldPoint(f"s{k}", p, 1e-3, "tool", k * 10 * SECOND, T, own, M, residual, 0 if k < 3 else -1)
        )
    return whole, held


def dense(whole, held, rows):
    """The unknowns that least squares of everything finds, and their covariance."""
    p, n = UNKNOWNS, UNKNOWNS + 6 * len(held) + 3
    prior = np.zeros((n, n))
    prior[:p, :p] = whole.found.P_zz
    for k, h in enumerate(held):
        at = slice(p + 6 * k, p + 6 * k + 6)
        prior[at, at] = h.own
    prior[-3:, -3:] = KNOWN_M**2 * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(prior))

    def everything(y):
        out = [root @ y]
        for k in rows:
            h = held[k]
            T = h.T_world_body @ se3.exp(y[p + 6 * k : p + 6 * k + 6] + h.M @ y[:p])
            point = h.p_world + (y[-3:] if h.known == 0 else 0.0)
            x = np.linalg.inv(T) @ np.append(point, 1.0)
            out.append((x[:3] - [0.5 if k % 2 else -0.5, 0.0, 0.0]) / h.sigma_m)
        return np.concatenate(out)

    found = least_squares(everything, np.zeros(n), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return found.x, np.linalg.inv(found.jac.T @ found.jac), 2 * found.cost


def test_shots_move_the_statics_as_a_dense_solve_does():
    whole, held = world(1)
    prior = _Prior.of(whole, held, [KNOWN_M])
    y, P, each, square = prior.fitted(list(range(len(held))))
    expected, covariance, cost = dense(whole, held, range(len(held)))
    sigma = np.sqrt(np.diagonal(covariance))
    print(f"apart by {np.abs((y - expected) / sigma).max():.1e} sigma")
    assert np.abs((y - expected) / sigma).max() < 5e-3
    assert P / np.outer(sigma, sigma) == pytest.approx(covariance / np.outer(sigma, sigma), abs=5e-3)
    assert square == pytest.approx(cost, rel=1e-3)
    # What a shot is off by without it: the dense solve of the others, held against it.
    others, Q, _ = dense(whole, held, range(1, len(held)))
    r, J, noise = prior.linearised(0, others)
    assert each[0].off == pytest.approx(r, abs=2e-5)
    assert each[0].covariance == pytest.approx(J @ Q @ J.T + noise, rel=1e-2, abs=1e-9)


def test_one_wrong_shot_is_named_and_two_are_not():
    whole, held = world(2, moved=4)
    culprit = _Prior.of(whole, held, [KNOWN_M]).culprit()
    assert (
        culprit is not None
        and culprit.name == "s4"
        and np.linalg.norm(culprit.off) == pytest.approx(0.05, abs=0.015)
    )
    # Where next to nothing is known, either of two explains the other away.
    whole, held = world(2, shots=2, moved=1, known=300.0)
    assert _Prior.of(whole, held, [KNOWN_M]).culprit() is None


def test_shots_no_further_apart_than_the_machine_stood_have_one_pose():
    _, held = world(3, shots=3)
    near = [
        HeldPoint(h.name, h.p_world, h.sigma_m, frame, at, h.T_world_body, h.own, h.M, h.residual)
        for h, frame, at in zip(held, ("tool", "tool", "stick"), (3 * SECOND // 2, 0, SECOND), strict=True)
    ]
    posed, numbers = held_points._by_stand(near)
    assert [h.name for h in posed] == ["s1", "s2", "s0"] and numbers == [0, 1, 0]
    assert posed[2].T_world_body is near[1].T_world_body and posed[2].own is near[1].own
    late = HeldPoint("late", near[0].p_world, 1e-3, "tool", 9 * SECOND, *_of(held[2]), held[2].residual)
    assert held_points._by_stand([*near, late])[1] == [0, 1, 0, 2]


def _of(h):
    return h.T_world_body, h.own, h.M


@pytest.mark.parametrize(("name", "x_m"), [("left", -0.5), ("middle", 0.0), ("right", 0.5), ("", None)])
def test_the_residual_of_an_edge_is_where_that_part_of_it_is(name, x_m):
    rng = np.random.default_rng(4)
    T = se3.exp(rng.normal(size=6))
    touch = EdgeTouch("t", 0, np.zeros(3), 1e-3, -1, name)
    residual = _residual_of(touch)
    for x in (-0.5, 0.0, 0.5, 0.3):
        r, by_pose, by_point, _ = residual(T, se3.transform(T, np.array([x, 0.0, 0.0])), np.zeros(2))
        expected = np.zeros(2) if x_m is None else np.array([x - x_m, 0.0, 0.0])
        assert r == pytest.approx(expected, abs=1e-12)
    p, h = se3.transform(T, np.array([0.1, 0.2, -0.1])), 1e-6
    by_differences = [
        (residual(T @ se3.exp(h * e), p, np.zeros(2))[0] - residual(T @ se3.exp(-h * e), p, np.zeros(2))[0])
        / (2 * h)
        for e in np.eye(6)
    ]
    _, by_pose, by_point, _ = residual(T, p, np.zeros(2))
    assert by_pose == pytest.approx(np.array(by_differences).T, abs=1e-8)
    by_differences = [
        (residual(T, p + h * e, np.zeros(2))[0] - residual(T, p - h * e, np.zeros(2))[0]) / (2 * h)
        for e in np.eye(3)
    ]
    assert by_point == pytest.approx(np.array(by_differences).T, abs=1e-8)


def _residual_of(touch):
    """As `belt._held` makes it, without a log."""
    caught = []
    whole = SimpleNamespace(network=SimpleNamespace(edge_m=1.0))
    original = belt.held_point
    belt.held_point = lambda *a: caught.append(a[6])
    try:
        belt._held(whole, [touch])
    finally:
        belt.held_point = original
    return caught[0]


@pytest.mark.parametrize("ratio", [1.0, -2.0])
def test_the_sigma_of_the_edge_is_the_scatter_of_drawn_belts(ratio):
    """Edge of drawn phases and tools, correlated, turned about the pin: the largest spread in the bucket's plane."""
    rng = np.random.default_rng(5)
    T_tool = se3.exp(np.array([1.2, 0.5, 0.1, 0.3, -0.2, 0.9]))
    A = rng.normal(size=(7, 7)) * np.array([3e-4, 2e-3, 2e-3, 2e-3, 1e-3, 1e-3, 1e-3])[:, None]
    A[0] += 1.5 * T_tool[0, :3] @ A[1:4]  # phase and tool are correlated
    joint = A @ A.T
    about = np.zeros((6, 6))
    about[5, 5] = joint[0, 0]
    cross = np.zeros((6, 6))
    cross[5] = joint[0, 1:]
    told = SimpleNamespace(
        value=lambda name: T_tool,
        covariance=lambda a, b=None: (
            cross if b is not None else about if a == belt.axis_static("flip") else joint[1:, 1:]
        ),
    )
    draws = rng.multivariate_normal(np.zeros(7), joint, size=200_000, method="eigh")
    # A larger phase of the axis is a smaller angle of the bucket, for the marker is seen where it is.
    angle = -draws[:, 0] / ratio
    edge = se3.transform(T_tool, draws[:, 1:4])
    # Only along the line from the pin is the tool told: across it the phase has everything.
    u = T_tool[:2, 3] / np.hypot(*T_tool[:2, 3])
    along = (edge[:, :2] - T_tool[:2, 3]) @ u
    across = np.hypot(*T_tool[:2, 3]) * angle
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(along, across))[-1])
    found = belt._edge_sigma(told, "flip", "tool", ratio)
    print(f"{1e3 * found:.3f} mm, drawn {1e3 * largest:.3f} mm")
    assert found == pytest.approx(largest, rel=0.01)
