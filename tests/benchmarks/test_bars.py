"""How the benchmarks of seeing count: whitening, ratios to a bound, distances at a recall."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import corners, occlusion
from benchmarks import range as distances
from benchmarks._draws import Outcome, draw_view
from benchmarks._tag_picture import View

AWAY = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / np.sqrt(2)


def outcome(error, cov) -> Outcome:
    return Outcome("", np.zeros((4, 2)), np.asarray(error, float).reshape(4, 2), cov)


def trial(error, bound_px) -> corners.Trial:
    covariance = np.eye(8) * bound_px**2
    return corners.Trial((0,), View(), outcome(error, covariance), np.zeros((4, 2)), bound_px, bound_px, AWAY)


def test_errors_drawn_from_a_covariance_are_one_when_whitened_by_it():
    """4000 draws: within 2 %, by the 8 x 8 and corner by corner."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(8, 8))
    cov = root @ root.T
    drawn = [outcome(root @ rng.normal(size=8), cov) for _ in range(4000)]
    assert corners.rms([each.whitened() for each in drawn]) == pytest.approx(1, rel=0.02)
    assert corners.rms([each.corners_whitened() for each in drawn]) == pytest.approx(1, rel=0.02)
    distances_2 = np.array([each.corner_distances() for each in drawn]) ** 2
    assert distances_2.mean() == pytest.approx(2, rel=0.04)


def test_each_error_counts_by_the_bound_of_its_own_trial():
    """A noisy trial at its bound and a quiet one three times over: the noisy one does not hide the quiet one."""
    cell = corners.summary("two", [trial(np.full(8, 0.1), 0.1), trial(np.full(8, 0.003), 0.001)])
    assert cell.ratio == pytest.approx(np.sqrt((1 + 9) / 2))


def test_a_tag_that_looks_larger_is_a_bias_outward():
    cell = corners.summary("large", [trial(0.05 * AWAY, 0.01), trial(0.03 * AWAY, 0.01)])
    assert cell.outward_px == pytest.approx(0.04)
    assert cell.worst_bias_px == pytest.approx(0.04)
    assert "bias" in corners.missed_bars(replace(cell, ratio=1.0), small=False)


def test_a_corner_six_sigmas_off_is_counted():
    error = np.zeros(8)
    error[4] = 0.06
    draws = [
        occlusion.Draw(k, View(covered=0.1), {"found": outcome(wrong * error, 1e-4 * np.eye(8))})
        for k, wrong in enumerate((0.5, 1.0))
    ]
    row = occlusion.summary("found", occlusion.SHARES, draws)
    assert (row.draws, row.stand, row.over) == (2, 2, 1)
    assert row.furthest == pytest.approx(6)


def test_reach_is_where_recall_first_falls_below_nine_tenths():
    """On a line between two sizes, from the largest down; a lucky small size does not count."""
    assert distances.reach_px([30, 20, 10, 5], [1.0, 1.0, 0.8, 1.0]) == pytest.approx(15)
    assert distances.reach_px([30, 20], [1.0, 0.95]) == 20
    assert np.isnan(distances.reach_px([30, 20], [0.5, 1.0]))


def test_drawn_views_keep_to_the_ranges_that_the_bars_speak_of():
    rng = np.random.default_rng(2)
    views = [draw_view(rng, 80, 45) for _ in range(300)]
    for field, low, high in (("blur_px", 0.5, 1.5), ("noise", 1, 6), ("quality", 70, 95), ("slope", 0, 0.2)):
        values = [getattr(view, field) for view in views]
        assert low <= min(values) < low + 0.05 * (high - low) + (field == "quality")
        assert high - 0.05 * (high - low) - (field == "quality") < max(values) <= high
