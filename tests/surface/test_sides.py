"""The sides of the floor: known passes, drawn noise, and a slope that was cut."""

import numpy as np
import pytest

from pipeline.surface.as_built import SurfaceRule, as_built
from pipeline.surface.decision import FAIL, PASS, ToleranceBand, judge, judge_sides, with_sides
from pipeline.surface.design import ProfileDesign
from pipeline.surface.sides import sides
from pipeline.surface.sweep import path_along
from pipeline.tracks.poses import CuttingEdge

STATION = np.arange(3.0, 7.5, 0.5)


def of(trench, edge, design=None):
    design = design or trench.design
    path = path_along(edge, trench.alignment)
    built = as_built(edge, trench.alignment, design, 0.05, path=path)
    return sides(path, built, design, STATION, 0.5), built


def lane(trench, offsets, height=50.0, noise=None, sigma_m=0.0, common_m=0.0):
    """Level passes along the trench at offsets, with lateral errors per pass and their covariance."""
    edge = trench.passes(np.full(len(offsets), height))
    count = len(edge) // len(offsets)
    shift = np.repeat(np.asarray(offsets, float) + (0.0 if noise is None else noise), count)
    right = np.array([0.8, -0.6])  # of the alignment, which runs along (0.6, 0.8)
    p = edge.p_grid.copy()
    p[..., :2] += shift[:, None, None] * right
    cov, common = np.zeros_like(edge.cov), np.zeros_like(edge.common)
    for array, variance in ((cov, sigma_m**2 + common_m**2), (common, common_m**2)):
        for k, (i, j) in {0: (0, 0), 1: (0, 1), 3: (1, 1)}.items():
            array[..., k] = variance * right[i] * right[j]
    return CuttingEdge(edge.time_ns, p, edge.seen, cov, common)


def test_one_pass_gives_its_own_ends_and_their_sigmas(trench):
    found, _ = of(trench, lane(trench, [0.02], sigma_m=0.003, common_m=0.004))
    np.testing.assert_allclose(found.outward, np.tile([-0.02, 0.02], (len(STATION), 1)), atol=1e-6)
    np.testing.assert_allclose(found.sigma_own, 0.003, rtol=1e-3)
    np.testing.assert_allclose(found.sigma_common, 0.004, rtol=1e-3)
    np.testing.assert_allclose(found.width, 1.0, atol=1e-6)
    # Both sides move together: the width knows nothing of the common error.
    np.testing.assert_allclose(found.sigma_width_common, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.sigma_width_own, 0.003 * np.sqrt(2), rtol=1e-3)


def test_the_outermost_of_two_lanes_is_the_side(trench):
    found, _ = of(trench, lane(trench, [-0.10, 0.07], sigma_m=0.001))
    np.testing.assert_allclose(found.outward, np.tile([0.10, 0.07], (len(STATION), 1)), atol=2e-4)
    np.testing.assert_allclose(found.width, 1.17, atol=4e-4)


def test_what_flies_high_or_lies_beside_an_uncut_floor_is_no_side(trench):
    found, _ = of(trench, lane(trench, [0.0], height=50.2))
    assert np.isnan(found.outward).all() and np.isnan(found.width).all()


@pytest.mark.parametrize("wander_m", [0.0, 0.012])
def test_the_outermost_of_many_noisy_passes_is_not_taken_for_the_side(trench, wander_m):
    rng = np.random.default_rng(5)
    sigma, plain, freed = 0.004, [], []
    for _ in range(20):
        offsets = rng.normal(0, wander_m, 6)
        edge = lane(trench, offsets, noise=rng.normal(0, sigma, 6), sigma_m=sigma)
        found, _ = of(trench, edge)
        truth = np.array([-offsets.min(), offsets.max()])
        freed.append(np.nanmean(found.outward - truth, axis=0) / sigma)
        across = trench.alignment.station_offset(edge.p_grid[..., :2])[1].reshape(6, -1, 3)
        measured = np.median(across, axis=1)
        plain.append((np.array([-measured[:, 0].min(), measured[:, 2].max()]) - 0.5 - truth) / sigma)
    freed, plain = np.array(freed), np.array(plain)
    rms = np.sqrt(np.mean(freed**2))
    print(f"bias in sigmas: freed {freed.mean():+.2f}, plain {plain.mean():+.2f}; RMS {rms:.2f}")
    # Passes that all lie in one place: the outermost of six is 1.27 sigma too far out.
    assert plain.mean() > 0.9 if wander_m == 0 else abs(plain.mean()) < 0.3
    assert abs(freed.mean()) < 0.4 and rms < 1.2


def test_a_sloped_side_is_compared_at_its_own_height(trench):
    flared = ProfileDesign("d", np.array([0.0, 10.0]), np.full(2, 50.0), np.full(2, 0.9), np.full(2, 0.5))
    # The ends lie at 0.5, where the slope of the design stands 0.1 above the floor: level with 50.1, not with 50.0.
    at_floor, _ = of(trench, lane(trench, [0.0], height=50.0), flared)
    higher, _ = of(trench, lane(trench, [0.0], height=50.08), flared)
    np.testing.assert_allclose(at_floor.outward, 0.05, atol=0.006)
    np.testing.assert_allclose(higher.outward, 0.05 - 0.5 * 0.08, atol=0.006)


def test_the_slope_that_was_cut_is_found_with_a_sigma_that_covers_it(trench):
    flared = ProfileDesign("d", np.array([0.0, 10.0]), np.full(2, 50.0), np.full(2, 1.0), np.full(2, 1.0))
    count = 120
    offsets = np.arange(0.575, 1.2, 0.05)  # one pass over each column of cells
    heights = 50.0 + (offsets - 0.5) / 1.25  # cut at 1.25 instead of 1 run per rise
    rows = [
        (k * 12 + np.arange(count) / 20, np.linspace(2, 8, count), np.full(count, o), np.full(count, h))
        for k, (o, h) in enumerate(zip(offsets, heights))
    ]
    floor = (-10 + np.arange(count) / 20, np.linspace(2, 8, count), np.zeros(count), np.full(count, 50.0))
    t, s, o, h = (np.concatenate(part) for part in zip(floor, *rows))
    wide = np.abs(o) < 0.01
    narrow = trench.edge(t, s, o, h, width=0.05, sigma=0.002)
    broad = trench.edge(t, s, o, h, width=1.0, sigma=0.002)
    p = np.where(wide[:, None, None], broad.p_grid, narrow.p_grid)
    edge = CuttingEdge(narrow.time_ns, p, narrow.seen, narrow.cov, narrow.common)
    path = path_along(edge, trench.alignment)
    built = as_built(edge, trench.alignment, flared, 0.05, SurfaceRule(step_m=0.5), path)
    found = sides(path, built, flared, STATION, 0.5)
    right = found.slope[:, 1]
    assert np.isfinite(right).all() and np.isnan(found.slope[:, 0]).all()
    np.testing.assert_allclose(right, 1.25, atol=0.05)
    assert np.all(np.abs(right - 1.25) < 3 * found.sigma_slope[:, 1])


def test_a_station_fails_by_its_side_and_passes_only_with_both(trench):
    edge = lane(trench, [0.06, 0.0], sigma_m=0.001)
    found, built = of(trench, edge)
    stations = judge(built, trench.design, STATION, 0.5, ToleranceBand(0.03, 0.03))
    assert set(stations.verdict) == {PASS}
    judged = judge_sides(found, ToleranceBand(0.05, 0.02))
    assert set(judged.verdict[:, 0]) == {PASS} and set(judged.verdict[:, 1]) == {FAIL}
    both = with_sides(stations, judged)
    assert set(both.verdict) == {FAIL}
    assert both.reason[0].startswith("right side wide by at least")
    assert set(with_sides(stations, judge_sides(found, ToleranceBand(0.10, 0.05))).verdict) == {PASS}
