"""The sweep against a brute-force loop over shapely triangles, and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from pipeline.surface.alignment import polyline
from pipeline.surface.sweep import CellGrid, SweepSettings, path_along, sweep
from pipeline.tracks.poses import CuttingEdge

HIGH = 1e9


def everywhere(grid):
    return np.full((grid.rows, grid.columns), HIGH)


def brute_force(path, grid, gap_ns):
    """Cell -> list of passes (lowest height, time), by asking shapely about every cell and triangle."""
    found = {}
    s, o = np.meshgrid(grid.station, grid.offset, indexing="ij")
    centers = shapely.points(s.ravel(), o.ravel())
    for k in np.flatnonzero(path.swept):
        p = path.soh
        for i in (0, 1):
            for a, b, c in ((p[k, i], p[k, i + 1], p[k + 1, i]), (p[k, i + 1], p[k + 1, i + 1], p[k + 1, i])):
                triangle = shapely.Polygon([a[:2], b[:2], c[:2]])
                if triangle.area < 1e-12:
                    continue
                for cell in np.flatnonzero(shapely.intersects(triangle, centers)):
                    q = np.array([s.flat[cell], o.flat[cell]])
                    w = np.linalg.solve(np.column_stack([b - a, c - a])[:2], q - a[:2])
                    h = a[2] + w @ [b[2] - a[2], c[2] - a[2]]
                    passes = found.setdefault(int(cell), [])
                    if not passes or path.time_ns[k] - passes[-1][2] > gap_ns:
                        passes.append([h, path.time_ns[k], path.time_ns[k]])
                    if h < passes[-1][0]:
                        passes[-1][:2] = [h, path.time_ns[k]]
                    passes[-1][2] = path.time_ns[k]
    return found


def wandering_edge(trench, n=120, seed=0):
    """An edge that wanders over two square metres, turning and tilting."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.05
    middle = np.column_stack([2 + np.sin(1.3 * t) + 0.1 * t, np.cos(0.9 * t), 50 + 0.3 * np.sin(2 * t)])
    turn = 0.6 * np.sin(0.7 * t)
    along = np.column_stack([np.sin(turn), np.cos(turn), 0.1 * np.sin(t)]) * 0.3
    soh = np.stack([middle - along, middle + rng.normal(0, 0.002, (n, 3)), middle + along], axis=1)
    edge = trench.edge(t, 2.0, 0.0, 50.0)
    p = np.concatenate([trench.alignment.points(soh[..., 0], soh[..., 1]), soh[..., 2:]], axis=-1)
    return replace(edge, p_grid=p)


def test_every_pass_over_every_cell_is_the_one_a_brute_force_loop_finds(trench):
    path = path_along(wandering_edge(trench), trench.alignment)
    grid = CellGrid(0.1, 0.0, -1.5, 45, 30)
    settings = SweepSettings(pass_gap_s=0.6)
    passes = sweep(path, grid, everywhere(grid), settings)
    wanted = brute_force(path, grid, 0.6e9)
    assert len(wanted) > 200 and sum(len(p) for p in wanted.values()) > 260
    # A centre within rounding of a triangle's edge may fall on either side in one of the two: none does here.
    assert sorted(wanted) == np.flatnonzero(passes.crossed).tolist()
    for cell, expected in wanted.items():
        mine = slice(passes.first[cell], passes.first[cell + 1])
        assert np.allclose(passes.height[mine], [h for h, _, _ in expected], rtol=0, atol=1e-9)
        assert passes.time_ns[mine].tolist() == [t for _, t, _ in expected]
        assert passes.crossed[cell] == len(expected)
        assert passes.lowest[cell] == pytest.approx(min(h for h, _, _ in expected), abs=1e-9)


def test_what_flies_above_the_ceiling_is_counted_and_not_kept(trench):
    edge = trench.passes([50.0, 52.0, 50.1])
    path = path_along(edge, trench.alignment)
    grid = CellGrid(0.1, 3.0, -0.3, 20, 6)
    passes = sweep(path, grid, np.full((20, 6), 51.0))
    assert np.all(passes.crossed == 3)
    assert np.all(passes.count == 2)
    assert np.allclose(passes.height.reshape(-1, 2), [50.0, 50.1])
    assert np.allclose(passes.lowest, 50.0)
    none = sweep(path, grid, np.full((20, 6), np.nan))
    assert len(none.height) == 0 and np.all(none.crossed == 3)


def test_a_bridged_stretch_touches_nothing(trench):
    edge = trench.passes([50.0])
    station, _ = trench.alignment.station_offset(edge.p_grid[:, 1, :2])
    edge = replace(edge, seen=(station < 4.0) | (station > 6.0))
    grid = CellGrid(0.1, 2.5, -0.3, 50, 6)
    crossed = sweep(path_along(edge, trench.alignment), grid, everywhere(grid)).crossed.reshape(50, 6)
    assert np.all(crossed[grid.station < 3.8] == 1)
    assert np.all(crossed[(grid.station > 4.05) & (grid.station < 5.95)] == 0)
    assert np.all(crossed[grid.station > 6.2] == 1)


def test_nothing_is_swept_across_a_pause_of_the_log(trench):
    edge = trench.edge(np.array([0.0, 0.2, 0.9, 1.1]), np.array([1.0, 1.2, 1.9, 2.1]), 0.0, 50.0)
    grid = CellGrid(0.1, 1.0, -0.2, 11, 4)
    crossed = sweep(path_along(edge, trench.alignment), grid, everywhere(grid)).crossed.reshape(11, 4)[:, 0]
    assert crossed.tolist() == [1, 1, 0, 0, 0, 0, 0, 0, 0, 1, 1]


def test_resting_over_a_cell_is_one_pass(trench):
    t = np.arange(0, 20, 0.05)
    edge = trench.edge(t, 2.0 + 0.1 * np.sin(t * 9), 0.0, 50.0)
    grid = CellGrid(0.05, 1.95, -0.2, 2, 8)
    assert np.all(sweep(path_along(edge, trench.alignment), grid, everywhere(grid)).crossed == 1)


def test_a_coarse_path_is_bent_and_not_cut_straight(trench):
    """At 5 Hz the chord of a bowl of 2 m/s² lies 10 mm above its bottom; the cubic follows it."""
    t = np.arange(0, 3, 0.2) - 1.5
    edge = trench.edge(t + 2, 5 + t, 0.0, 50 + t**2)
    grid = CellGrid(0.05, 4.5, -0.1, 20, 4)
    errors = {}
    for name, fine in (("chord", 10.0), ("cubic", 0.06)):
        passes = sweep(
            path_along(edge, trench.alignment, SweepSettings(interpolation_s=fine)), grid, everywhere(grid)
        )
        errors[name] = passes.lowest.reshape(20, 4)[:, 0] - (50 + (grid.station - 5) ** 2)
    assert errors["chord"].max() > 0.009
    assert np.abs(errors["cubic"]).max() < 0.001


def test_sigma_is_vertical_on_the_level_and_takes_in_the_horizontal_on_a_ramp(trench):
    t = np.arange(0, 3, 0.05)
    for rise in (0.0, 1.0):
        edge = trench.edge(t, 3 + t, 0.0, 50 + rise * t)
        cov = np.zeros((len(t), 3, 6))
        # 3 mm along the trench, 7 mm across it, 4 mm vertical; no correlation.
        a, b = 0.6, 0.8
        cov[..., 0] = a * a * 9e-6 + b * b * 49e-6
        cov[..., 1] = a * b * (9e-6 - 49e-6)
        cov[..., 3] = b * b * 9e-6 + a * a * 49e-6
        cov[..., 5] = 16e-6
        edge = replace(edge, cov=cov, common=np.zeros_like(cov))
        grid = CellGrid(0.1, 3.5, -0.2, 15, 4)
        passes = sweep(path_along(edge, trench.alignment), grid, everywhere(grid))
        wanted = 0.005 if rise else 0.004  # sqrt(4² + 3²)
        assert np.allclose(passes.sigma_own, wanted, rtol=1e-5)
        assert np.all(passes.sigma_common == 0)


def test_the_path_turns_with_the_alignment():
    """Offsets at a bend: a strip that follows the arc covers the same offsets all the way."""
    bend = polyline([[0, 0], [0, 10], [7, 17], [17, 17]])
    t = np.arange(0, 24, 0.1)
    p = np.stack(
        [np.column_stack([bend.points(1 + t, x), np.full(len(t), 5.0)]) for x in (-0.3, 0, 0.3)], axis=1
    )
    zeros = np.zeros((len(t), 3, 6))
    edge = CuttingEdge((t * 1e9).astype(np.int64), p, np.ones(len(t), bool), zeros, zeros)
    grid = CellGrid(0.1, 2.0, -0.5, 200, 10)
    crossed = sweep(path_along(edge, bend), grid, everywhere(grid)).crossed.reshape(200, 10) > 0
    inside = np.abs(grid.offset) < 0.3
    assert crossed[:, inside].mean() > 0.97  # a few cells at the two corners
    assert not crossed[:, np.abs(grid.offset) > 0.35].any()
