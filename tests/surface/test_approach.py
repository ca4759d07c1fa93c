"""Closest approaches against closed forms, dense sampling, scipy's minimiser and drawn truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize

from pipeline.surface.approach import KEPT, Line, approaches
from pipeline.surface.nearest import ERROR_M, between
from pipeline.tracks.poses import CuttingEdge

BASE = np.array([512_345.0, 4_123_456.0, 50.0])
T0 = 1_750_000_000_000_000_000
REACH_M = 2.0


def edge_of(time_s, middle, along=(0.5, 0, 0), sigma=0.0, common=0.0, seen=None):
    """An edge whose middle is at BASE + middle; `along` is from there to its right end; sigmas alike all round."""
    n = len(time_s)
    middle, along = (np.broadcast_to(np.asarray(part, float), (n, 3)) for part in (middle, along))
    cov, shared = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
    cov[..., [0, 3, 5]], shared[..., [0, 3, 5]] = sigma**2 + common**2, common**2
    p = BASE + np.stack([middle - along, middle, middle + along], axis=1)
    time_ns = T0 + np.round(np.asarray(time_s) * 1e9).astype(np.int64)
    return CuttingEdge(time_ns, p, np.ones(n, bool) if seen is None else np.asarray(seen), cov, shared)


def line_of(points, radius=0.0, horizontal=0.0, vertical=0.0, clearance=0.5):
    points = BASE + np.asarray(points, float)
    return Line(points[:-1], points[1:], np.full(len(points) - 1, radius), horizontal, vertical, clearance)


def one(edge, line):
    return approaches(edge, [line], REACH_M)[0]


def wandering(seed, n=300, step_s=0.1):
    """An edge that wanders and turns within some metres; smooth, so that the cubic between epochs is its way."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * step_s
    a, f, phase = rng.uniform(0.5, 3, (3, 1)), rng.uniform(0.3, 1.2, (3, 1)), rng.uniform(0, 6, (3, 1))
    middle = (a * np.sin(f * t + phase)).T
    turn = rng.uniform(0.2, 1.0) * t
    along = 0.5 * np.stack([np.cos(turn), np.sin(turn), 0.3 * np.sin(2 * turn)], axis=1)
    return t, edge_of(t, middle, along)


def dense(edge, line, parts=60):
    """(k, u, distance) of many instants by brute force: a spline of scipy between epochs, points along the edge."""
    t = (edge.time_ns - edge.time_ns[0]) * 1e-9
    p = edge.p_grid - BASE
    slope = np.empty_like(p)
    slope[1:-1] = (p[2:] - p[:-2]) / (t[2] - t[0])  # even steps
    slope[0], slope[-1] = (p[1] - p[0]) / (t[1] - t[0]), (p[-1] - p[-2]) / (t[1] - t[0])
    fine = np.linspace(t[0], t[-1], parts * (len(t) - 1) + 1)
    q = CubicHermiteSpline(t, p, slope)(fine)
    share = np.linspace(0, 1, 41)[:, None, None, None]
    places = np.concatenate([q[:, :2] * (1 - share) + q[:, 1:] * share]).reshape(len(share), len(fine), 2, 3)
    best = np.full(len(fine), np.inf)
    for a, b, r in zip(line.start - BASE, line.end - BASE, line.radius):
        along = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        distance = np.linalg.norm(places - a - along[..., None] * (b - a), axis=-1) - r
        best = np.minimum(best, distance.min(axis=(0, 2)))
    return fine, best


@pytest.mark.parametrize("seed", range(12))
def test_two_segments_are_as_far_apart_as_scipy_finds_them(seed):
    rng = np.random.default_rng(seed)
    p, q, a, b = rng.normal(0, 1, (4, 3))
    if seed % 4 == 1:
        b = a + (q - p) * 0.7  # parallel
    if seed % 4 == 2:
        q = p.copy()  # a point
    found = minimize(
        lambda x: np.sum((p + x[0] * (q - p) - a - x[1] * (b - a)) ** 2), [0.5, 0.5],
        bounds=[(0, 1)] * 2, method="L-BFGS-B", options={"ftol": 1e-16, "gtol": 1e-12},
    )  # fmt: skip
    distance, s, t = between(p, q, a, b)
    assert distance == pytest.approx(np.sqrt(found.fun), abs=1e-6)
    assert np.linalg.norm(p + s * (q - p) - a - t * (b - a)) == pytest.approx(distance, abs=1e-12)
    assert 0 <= s <= 1 and 0 <= t <= 1


@pytest.mark.parametrize("seed", range(8))
def test_the_closest_approach_is_that_of_dense_sampling(seed):
    _, edge = wandering(seed)
    rng = np.random.default_rng(100 + seed)
    points = rng.normal(0, 2.5, (6, 3)) + ([0, 0, 30] if seed > 5 else 0)
    line = line_of(points, radius=0.05)
    near = one(edge, line)
    fine, wanted = dense(edge, line)
    # Dense sampling misses by its own steps: half of 2.5 mm in time at 1.5 m/s, 12 mm along the edge at a corner.
    assert near.closest.distance[0] <= wanted.min() + ERROR_M
    assert near.closest.distance[0] >= wanted.min() - 0.01
    assert np.interp((near.closest.time_ns[0] - T0) * 1e-9, fine, wanted) <= wanted.min() + 0.01


@pytest.mark.parametrize("seed", [0, 1, 3, 4])  # in 2 a pause of 1.98 s is cut at the next epoch
def test_every_approach_of_dense_sampling_is_an_event_and_nothing_else_is(seed):
    _, edge = wandering(seed, n=1200)
    line = line_of(np.random.default_rng(40 + seed).normal(0, 2, (5, 3)), radius=0.05, clearance=0.4)
    near = one(edge, line)
    fine, wanted = dense(edge, line, parts=20)
    inside = np.flatnonzero(wanted < 0.4)
    groups = np.split(inside, np.flatnonzero(np.diff(fine[inside]) > 2.0) + 1)
    start = np.sort(near.start_ns)
    assert len(groups) == near.inside + near.touching + near.near == len(start) > 3
    for group, at in zip(groups, (start - T0) * 1e-9):
        assert at == pytest.approx(fine[group[0]], abs=0.11)
    lowest = sorted(wanted[group].min() for group in groups)
    assert np.allclose(np.sort(near.events.distance), lowest, atol=0.01)


def test_a_straight_pass_over_a_straight_pipe_in_numbers():
    """0.8 m above the axis of a pipe of 150 mm: 0.65 m, where the edge crosses it, 2.5 s after the start."""
    t = np.arange(0, 5.01, 0.1)
    edge = edge_of(t, np.column_stack([0 * t, t - 2.5, 0 * t + 0.8]))
    near = one(edge, line_of([[-3, 0, 0], [3, 0, 0]], radius=0.15, clearance=0.7))
    assert near.closest.distance[0] == pytest.approx(0.65, abs=1e-12)
    assert near.closest.time_ns[0] == T0 + 2_500_000_000
    assert near.closest.bound[0] == pytest.approx(0.65)
    assert (near.inside, near.touching, near.near) == (0, 0, 1)
    # sqrt(0.85² - 0.8²) m either side of it are below the clearance.
    half = np.sqrt(0.85**2 - 0.8**2)
    assert (near.start_ns[0] - T0) * 1e-9 == pytest.approx(2.5 - half, abs=0.1)
    assert (near.end_ns[0] - T0) * 1e-9 == pytest.approx(2.5 + half, abs=0.1)


def test_a_pass_between_two_frames_is_not_missed():
    """At 5 m/s and 5 Hz the frames are a metre apart, and the cable lies in the middle between two."""
    t = np.arange(0, 3, 0.2)
    edge = edge_of(t, np.column_stack([0 * t, 5 * t - 5.5, 0 * t + 0.02]))
    line = line_of([[-3, 0, 0], [3, 0, 0]], radius=0.01, clearance=0.1)
    near = one(edge, line)
    assert near.closest.distance[0] == pytest.approx(0.01, abs=ERROR_M)
    assert near.near == 1 and (near.closest.time_ns[0] - T0) * 1e-9 == pytest.approx(1.1, abs=0.002)
    # Not seen at one of the two frames, nothing is known of what was between: it is told, not made up.
    hidden = one(replace(edge, seen=np.arange(len(t)) != 6), line)
    assert hidden.near == 0 and hidden.closest.distance[0] == pytest.approx(np.hypot(0.5, 0.02) - 0.01)
    assert (hidden.unseen, hidden.unseen_s) == (1, pytest.approx(0.4))


def test_sigmas_are_those_along_the_line_of_approach():
    """3 mm east, 7 north, 4 up (common 2 up); the line's 30 mm in plan and 60 up; approached from 3-4-5 north-up."""
    t = np.arange(0, 1, 0.1)
    edge = edge_of(t, [0, 0.6, 0.8])
    cov, common = np.zeros((10, 3, 6)), np.zeros((10, 3, 6))
    cov[..., 0], cov[..., 3], cov[..., 5], common[..., 5] = 9e-6, 49e-6, 16e-6, 4e-6
    cov[..., 4] = 10e-6  # of north and up
    near = one(replace(edge, cov=cov, common=common), line_of([[-3, 0, 0], [3, 0, 0]], 0.1, 0.03, 0.06))
    n = np.array([0.6, 0.8])
    own = n @ np.array([[49e-6, 10e-6], [10e-6, 12e-6]]) @ n
    assert near.closest.distance[0] == pytest.approx(0.9)
    assert near.closest.sigma_own[0] == pytest.approx(np.sqrt(own), rel=1e-9)
    assert near.closest.sigma_common[0] == pytest.approx(0.8 * 0.002, rel=1e-9)
    assert near.closest.sigma_line[0] == pytest.approx(np.hypot(0.6 * 0.03, 0.8 * 0.06), rel=1e-9)
    total = np.sqrt(own + 0.64 * 4e-6 + 0.36 * 9e-4 + 0.64 * 36e-4)
    # Far out the bound is 1.645 sigmas and what errors across add, about half their variance over the distance.
    assert near.closest.bound[0] == pytest.approx(0.9 - 1.645 * total, abs=0.002)


def test_an_edge_on_the_axis_is_inside_by_the_radius():
    near = one(edge_of([0.0, 0.1], [0, 0, 0], sigma=0.01), line_of([[0, -1, 0], [0, 1, 0]], 0.2))
    assert near.closest.distance[0] == pytest.approx(-0.2)
    assert near.inside == 1 and near.closest.bound[0] == pytest.approx(-0.2)


def test_stretches_without_sight_count_only_near_the_line():
    """Unseen from 2 to 5 s beside the line, and again for 8 s far from it."""
    t = np.arange(0, 40, 0.1)
    away = np.where(t < 20, 1.2, 9.0)
    seen = ~(((t > 2) & (t < 5)) | ((t > 25) & (t < 33)))
    near = one(edge_of(t, np.column_stack([0 * t, away, 0 * t]), seen=seen), line_of([[-3, 0, 0], [3, 0, 0]]))
    assert near.unseen == 1
    assert near.unseen_s == near.longest_unseen_s == pytest.approx(3.0, abs=0.11)
    assert near.longest_unseen_ns - T0 == pytest.approx(2e9, abs=1.1e8)
    # A log with a pause, beginning and ending unseen.
    t = np.array([0, 0.1, 0.2, 9.0, 9.1, 9.2])
    edge = edge_of(t, [0, 1.0, 0], seen=[False, True, True, True, True, False])
    near = one(edge, line_of([[-3, 0, 0], [3, 0, 0]]))
    assert near.unseen == 3 and near.unseen_s == pytest.approx(0.1 + 8.8 + 0.1)
    # Both ends of the pause are further than the reach, and the straight way between them is not.
    edge = edge_of(t[1:5], np.array([[0, -2.2, 0], [0, -2.1, 0], [0, 2.1, 0], [0, 2.2, 0]]))
    assert one(edge, line_of([[-3, 0, 0], [3, 0, 0]])).unseen_s == pytest.approx(8.8)
    assert one(edge, line_of([[-3, 0, 3], [3, 0, 3]])).unseen == 0
    edge = edge_of(t, [0, 1.0, 0], seen=[False, True, True, True, True, False])
    never = one(replace(edge, seen=np.zeros(6, bool)), line_of([[-3, 0, 0], [3, 0, 0]]))
    assert never.closest is None and never.unseen_s == pytest.approx(9.2) and never.near == 0


def test_all_approaches_are_counted_and_the_gravest_kept():
    """120 passes, every 10 s, each a millimetre lower than the one before."""
    t = np.arange(0, 1200, 0.1)
    number = np.floor(t / 10)
    high = 0.5 * np.cos(2 * np.pi * t / 10) + 0.5
    edge = edge_of(t, np.column_stack([0 * t, 0 * t, 0.45 - 0.001 * number + high]))
    near = one(edge, line_of([[-3, 0, 0], [3, 0, 0]], 0.1, clearance=0.4))
    assert near.near == 120 and len(near.start_ns) == KEPT
    assert np.allclose(near.events.distance, 0.35 - 0.001 * np.arange(119, 119 - KEPT, -1), atol=1e-4)
    assert np.all(np.diff(near.events.bound) > 0)


def test_pipes_of_a_whole_town_change_nothing_but_the_time():
    _, edge = wandering(3)
    line = line_of(np.random.default_rng(3).normal(0, 2, (4, 3)), 0.05)
    rng = np.random.default_rng(4)
    far = BASE + np.concatenate([rng.uniform(100, 3000, (5000, 2)), rng.uniform(-5, 5, (5000, 1))], axis=1)
    town = replace(
        line,
        start=np.concatenate([line.start, far]),
        end=np.concatenate([line.end, far + 20.0]),
        radius=np.concatenate([line.radius, np.full(5000, 0.3)]),
    )
    a, b = one(edge, line), one(edge, town)
    assert a.closest.distance[0] == b.closest.distance[0] and a.start_ns.tolist() == b.start_ns.tolist()


def coverage(looks, own, common, of_line, true, radius, rng, draws=500):
    """Share of draws in which the lowest bound of a log lies below the true clearance, and of false strikes."""
    held = strikes = 0
    for _ in range(draws):
        shared = rng.normal(0, common, 3)
        off = rng.normal(0, of_line, 3)
        # One look every 30 s, resting there for a moment; its error is the same while it rests.
        t = (np.arange(looks)[:, None] * 30 + np.array([0.0, 0.1])).ravel()
        error = np.repeat(rng.normal(0, own, (looks, 3)), 2, axis=0)
        edge = edge_of(t, np.array([0, 0, true + radius]) + error + shared, sigma=own, common=common)
        near = one(edge, line_of([[-3, *off[1:]], [3, *off[1:]]], radius, of_line, of_line, clearance=5.0))
        held += near.events.bound[0] <= true
        strikes += near.closest.distance[0] <= 0
    return held / draws, strikes / draws


@pytest.mark.parametrize("looks", [1, 10, 100])
@pytest.mark.parametrize(
    "own, common, of_line", [(0.005, 0.005, 0.05), (0.01, 0.003, 0.0), (0.02, 0.0, 0.02)]
)
def test_at_least_95_of_100_bounds_hold_however_many_looks(looks, own, common, of_line, capsys):
    """One look: 95 in 100. The lowest of many noisy looks lies too low, so with many more hold: the safe side."""
    rng = np.random.default_rng([looks, round(1000 * own)])
    draws = {1: 2000, 10: 500, 100: 100}[looks]
    held, _ = coverage(looks, own, common, of_line, true=0.3, radius=0.1, rng=rng, draws=draws)
    with capsys.disabled():
        sigmas = " / ".join(f"{1000 * s:g}" for s in (own, common, of_line))
        print(
            f"\n  bounds that hold: {100 * held:.1f} % of {draws}, {looks} looks, own / common / line {sigmas} mm"
        )
    assert held >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / draws)
    if looks == 1:
        assert held <= 0.95 + 3 * np.sqrt(0.95 * 0.05 / draws)
