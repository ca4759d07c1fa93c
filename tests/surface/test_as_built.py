"""The as-built surface of a trench whose truth is known: errors, states, gaps, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SurfaceError
from pipeline.surface.as_built import SurfaceRule, as_built, reach_of
from pipeline.surface.design import ProfileDesign

CUT, OVER, NEVER = 2, 1, 0


def rows(built, low, high):
    return (built.grid.station > low) & (built.grid.station < high)


def test_an_edge_without_noise_gives_the_floor_it_swept(trench):
    built = as_built(trench.passes([50.2, 50.0, 50.1]), trench.alignment, trench.design, 0.05)
    inside = rows(built, 2.05, 7.95)
    assert np.all(built.state[inside][:, built.floor[0]] == CUT)
    assert np.allclose(built.h[inside][:, built.floor[0]], 50.0, rtol=0, atol=1e-9)
    assert np.allclose(built.deviation[inside][:, built.floor[0]], 0.0, rtol=0, atol=1e-9)
    assert np.all(built.passes[inside][:, built.floor[0]] == 3)


def test_soil_the_edge_did_not_reach_is_not_claimed(trench):
    built = as_built(trench.passes([50.0], width=0.6), trench.alignment, trench.design, 0.05)
    middle = rows(built, 3, 7)
    # The floor is 1 m wide, the edge 0.6 m: what is left on both sides was never touched.
    touched = np.abs(built.grid.offset) < 0.3
    assert np.all(built.state[middle][:, touched] == CUT)
    assert np.all(built.state[middle][:, ~touched] == NEVER)
    assert np.isnan(built.h[middle][:, ~touched]).all()
    assert built.floor[middle][:, ~touched].any()


def test_a_flight_over_the_trench_is_passed_over_and_not_a_floor(trench):
    low, high = trench.passes([50.0], 2, 5), trench.passes([51.5], 2, 8)
    both = replace(
        low,
        **{
            name: np.concatenate([getattr(low, name), getattr(high, name)])
            for name in ("p_grid", "seen", "cov", "common")
        },
        time_ns=np.concatenate([low.time_ns, high.time_ns + 20_000_000_000]),
    )
    built = as_built(both, trench.alignment, trench.design, 0.05)
    assert np.all(built.state[rows(built, 2.1, 4.9)][:, built.floor[0]] == CUT)
    flown = built.state[rows(built, 5.1, 7.9)][:, built.floor[0]]
    assert np.all(flown == OVER)
    assert np.allclose(built.h_lowest[rows(built, 5.1, 7.9)][:, built.floor[0]], 51.5)
    assert np.isnan(built.h[rows(built, 5.1, 7.9)]).all()


def test_a_narrow_ridge_among_lower_cells_is_passed_over_and_a_ramp_is_cut(trench):
    t = np.arange(0, 6, 0.02)
    ridge = np.where(np.abs(t - 2) < 0.06, 50.2, 50.0)
    built = as_built(trench.edge(t, 2 + t, 0.0, ridge), trench.alignment, trench.design, 0.05)
    floor = built.floor[0]
    assert np.all(built.state[rows(built, 3.97, 4.03)][:, floor] == OVER)
    assert np.all(built.state[rows(built, 4.3, 7)][:, floor] == CUT)
    ramp = np.clip(50.0 + (t - 2), 50.0, 50.25)  # one in one
    built = as_built(trench.edge(t, 2 + t, 0.0, ramp), trench.alignment, trench.design, 0.05)
    assert np.all(built.state[rows(built, 2.1, 7.9)][:, floor] == CUT)


def test_over_dug_width_beside_vertical_walls_is_seen_outside_the_design(trench):
    built = as_built(trench.passes([50.0], width=1.4), trench.alignment, trench.design, 0.05)
    middle = rows(built, 3, 7)
    beside = (np.abs(built.grid.offset) > 0.5) & (np.abs(built.grid.offset) < 0.7)
    assert np.all(built.state[middle][:, beside] == CUT)
    assert np.isnan(built.design_h[middle][:, beside]).all()
    assert not built.floor[middle][:, beside].any()


def test_open_ground_under_the_prolonged_side_slope_is_not_a_cut(trench):
    sloped = replace(trench.design, side_slope=np.array([0.5, 0.5]))
    # A bucket set down at 51.5 m, 1.5 m beside the axis, where the slope would be at 52 m; and one on the slope.
    for height, state in ((51.5, OVER), (51.9, CUT), (50.1, CUT)):
        edge = trench.edge(np.arange(0, 3, 0.1), np.linspace(3, 6, 30), 1.5, height, width=0.2)
        built = as_built(edge, trench.alignment, sloped, 0.05)
        under = built.state[rows(built, 3.1, 5.8)][:, np.abs(built.grid.offset - 1.5) < 0.03]
        assert np.all(under == state), height


def test_the_last_pass_is_the_surface_of_placed_material(trench):
    edge = trench.passes([49.9, 50.0, 50.1, 52.0])
    lowest = as_built(edge, trench.alignment, trench.design, 0.1)
    last = as_built(edge, trench.alignment, trench.design, 0.1, SurfaceRule(surface="last"))
    inside = rows(last, 2.1, 7.9)
    assert np.allclose(lowest.h[inside][:, lowest.floor[0]], 49.9)
    assert np.allclose(last.h[inside][:, last.floor[0]], 50.1)  # the flight at 52 m placed nothing
    assert np.allclose(last.h_lowest[inside][:, last.floor[0]], 49.9)


def dug(trench, rng, finishing=3, own=0.005, common=0.003):
    """A noisy edge and the true floor: layers, then finishing passes that scatter by 3 mm; noise of each pass is
    slow against the pass, as that of an adjusted trajectory is; the common error is one for all.
    """
    true = np.concatenate([50 + np.array([0.9, 0.6, 0.3, 0.12]), 50 + rng.normal(0, 0.003, finishing)])
    count, knots = 60, 13
    noise = [
        np.interp(np.linspace(0, 1, count), np.linspace(0, 1, knots), rng.normal(0, own, knots)) for _ in true
    ]
    # Between knots interpolation shrinks the scatter by a third of the variance on average.
    claimed = own * np.sqrt(2 / 3)
    shared = rng.normal(0, common)
    edge = trench.passes(true, sigma=claimed, common=common, noise=[n + shared for n in noise])
    return edge, true.min()


def errors(trench, draws, corrected):
    z, e = [], []
    for seed in range(draws):
        edge, floor = dug(trench, np.random.default_rng(seed))
        built = as_built(edge, trench.alignment, trench.design, 0.1, SurfaceRule(corrected=corrected))
        cut = built.cut & built.floor & rows(built, 2.2, 7.8)[:, None]
        # One column is enough: the edge is level, so the cells of a row share one error.
        column = int(np.argmin(np.abs(built.grid.offset)))
        cells = cut[:, column]
        error = built.h[cells, column] - floor
        e.append(error)
        z.append(error / np.hypot(built.sigma_own[cells, column], built.sigma_common[cells, column]))
    return np.concatenate(e), np.concatenate(z)


def test_cell_errors_are_what_their_sigma_says_and_the_correction_is_needed_for_it(trench):
    _, z = errors(trench, 40, corrected=True)
    # 40 draws of the common error, and some 13 independent stretches in each: a mean is known to 0.1.
    assert abs(z.mean()) < 0.25
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15
    _, plain = errors(trench, 40, corrected=False)
    assert plain.mean() < -0.4


def test_an_edge_that_never_was_over_the_alignment_is_told_how_far_it_was(trench):
    away = trench.edge(np.arange(0, 5, 0.1), np.linspace(2, 8, 50), 25.0 + np.zeros(50), 50.0)
    with pytest.raises(SurfaceError, match=r"no nearer than 25\.0 m to its designed stretch"):
        as_built(away, trench.alignment, trench.design, 0.05)


def test_an_edge_that_was_never_seen_is_told_so(trench):
    edge = trench.passes([50.0])
    with pytest.raises(
        SurfaceError, match=r"never seen for two epochs in a row \(60 epochs, 0 of them seen\)"
    ):
        as_built(replace(edge, seen=np.zeros(60, bool)), trench.alignment, trench.design, 0.05)


def test_too_many_cells_are_refused(trench):
    wide = ProfileDesign(
        "wide", np.array([0.0, 10.0]), np.array([50.0, 50.0]), np.array([90.0, 90.0]), np.zeros(2)
    )
    with pytest.raises(SurfaceError, match=r"million cells of 1 mm.*raise survey\.cell_m"):
        as_built(trench.passes([50.0]), trench.alignment, wide, 0.001)


def test_the_same_edge_gives_the_same_surface_to_the_bit(trench):
    edge, _ = dug(trench, np.random.default_rng(5))
    one, two = (as_built(edge, trench.alignment, trench.design, 0.05) for _ in range(2))
    for name in ("state", "h", "sigma_own", "lowest_time_ns"):
        assert np.array_equal(getattr(one, name), getattr(two, name), equal_nan=name in ("h", "sigma_own"))


def test_the_chainage_reached_has_its_gaps(trench):
    two = [trench.passes([50.0], 2.0, 4.0), trench.passes([50.0], 5.5, 8.0)]
    later = two[1].time_ns + 60 * 10**9
    edge = replace(
        two[0],
        time_ns=np.concatenate([two[0].time_ns, later]),
        **{
            name: np.concatenate([getattr(part, name) for part in two])
            for name in ("p_grid", "seen", "cov", "common")
        },
    )
    reach = reach_of(as_built(edge, trench.alignment, trench.design, 0.05))
    assert reach.first == pytest.approx(2.0, abs=0.051) and reach.last == pytest.approx(8.0, abs=0.051)
    assert reach.dug == pytest.approx(4.5, abs=0.11)
    ((first, last),) = reach.gaps
    assert first == pytest.approx(4.0, abs=0.051) and last == pytest.approx(5.5, abs=0.051)
    nothing = reach_of(as_built(trench.passes([52.0]), trench.alignment, trench.design, 0.05))
    assert np.isnan(nothing.first) and nothing.dug == 0 and nothing.gaps == ()
