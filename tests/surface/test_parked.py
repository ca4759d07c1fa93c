"""Shots of the parked edge and of known points, against an edge whose every move is known."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.surface.as_built import as_built
from pipeline.surface.checks import COMPARED, USED, compare, summarise, without_used
from pipeline.surface.parked import (
    ELSEWHERE,
    NO_CLOCK,
    NOT_SET_DOWN,
    NOT_STILL,
    KnownPoint,
    compare_parked,
    with_known_points,
)
from pipeline.surface.rests import RestRule, rests_of, stand_at
from pipeline.surface.shots import NO_TIME, Shots
from tests.surface.conftest import T0

OWN, COMMON = 0.003, 0.004


@pytest.fixture(scope="module")
def parked(trench):
    """It digs for 3 s, stands at station 6 from 10 s to 20 s, swings, stands at station 2 from 30 s to 33 s."""
    t = np.arange(0, 40, 0.1)
    station = np.interp(t, [0, 3, 10, 20, 25, 30, 33, 40], [2, 8, 6, 6, 9, 2, 2, 8])
    h = np.interp(t, [0, 3, 10, 20, 25, 30, 33, 40], [50, 50, 51, 51, 52, 50.5, 50.5, 52])
    rng = np.random.default_rng(3)
    edge = trench.edge(t, station, 0.0, h, sigma=OWN, common=COMMON, noise=rng.normal(0, 0.001, len(t)))
    return edge, as_built(edge, trench.alignment, trench.design, 0.05)


def at(trench, station, offset, h):
    return np.append(trench.alignment.points(np.array([station]), np.array([offset]))[0], h)


def shots_of(rows):
    """Rows of kind, seconds or None, edge point, place."""
    return Shots(
        point=np.array([f"E{i}" for i in range(len(rows))], object),
        code=np.full(len(rows), "", object),
        p_grid=np.array([row[3] for row in rows]),
        kind=np.array([row[0] for row in rows], object),
        time_ns=np.array([NO_TIME if row[1] is None else T0 + round(row[1] * 1e9) for row in rows], np.int64),
        edge_point=np.array([row[2] for row in rows], object),
    )


def found_for(trench, parked, shots, **how):
    edge, built = parked
    return compare_parked(compare(shots, built, trench.alignment, 0.002), shots, edge, **how)


def test_rests_begin_and_end_where_the_edge_does(parked):
    edge, _ = parked
    rests = rests_of(edge)
    begin = (edge.time_ns[rests.first] - T0) / 1e9
    end = (edge.time_ns[rests.stop - 1] - T0) / 1e9
    # A centimetre and three sigmas of travel at 0.4 to 1.6 m/s.
    assert np.allclose(begin, [10, 30], atol=0.11) and np.allclose(end, [20, 33], atol=0.11)
    unseen = replace(edge, seen=np.where(np.abs((edge.time_ns - T0) / 1e9 - 15) < 0.06, False, edge.seen))
    assert len(rests_of(unseen)) == 3
    assert len(rests_of(edge, RestRule(still_s=4.0))) == 1


def test_a_slow_creep_is_many_rests_and_a_drift_within_one_is_bounded(trench):
    t = np.arange(0, 60, 0.1)
    rests = rests_of(trench.edge(t, 5.0, 0.0, 50 + 0.002 * t))
    walked = 0.002 * (rests.stop - 1 - rests.first) * 0.1
    assert len(rests) > 5 and walked.max() <= 0.010 + 1e-6


def test_the_edge_is_compared_in_three_directions_at_the_named_point(trench, parked):
    off = np.array([0.011, -0.007, 0.004])
    rows = [
        ("edge", 15.0, "left", at(trench, 6, -0.5, 51) - off),
        ("edge", 15.0, "middle", at(trench, 6, 0.0, 51) - off),
        ("edge", 31.0, "right", at(trench, 2, 0.5, 50.5) - off),
    ]
    found = found_for(trench, parked, shots_of(rows))
    assert found.result.tolist() == [COMPARED] * 3 and found.edge_point.tolist() == [
        "left",
        "middle",
        "right",
    ]
    difference = np.column_stack([found.difference_e, found.difference_n, found.difference])
    assert np.allclose(difference, off, rtol=0, atol=[1e-6, 1e-6, 6e-4])
    assert np.allclose(found.sigma_own, OWN, rtol=1e-6) and np.allclose(found.sigma_common, COMMON, rtol=1e-6)
    assert np.allclose(found.z, found.difference / np.hypot(0.005, 0.002), rtol=1e-6)


def test_without_a_name_the_nearest_place_counts_and_nothing_is_said_along_the_edge(trench, parked):
    along = np.array([0.8, -0.6, 0.0])  # across the alignment, which runs along (0.6, 0.8)
    p = at(trench, 6, 0.2, 51) - 0.01 * np.array([0.6, 0.8, 0.0])
    found = found_for(trench, parked, shots_of([("edge", 15.0, "", p)]))
    assert found.edge_point.tolist() == ["nearest"]
    difference = np.array([found.difference_e[0], found.difference_n[0], found.difference[0]])
    assert difference @ along == pytest.approx(0.0, abs=1e-6)
    assert difference[:2] @ [0.6, 0.8] == pytest.approx(0.01, abs=1e-6)
    assert np.abs(found.along_en[0] @ along[:2]) == pytest.approx(1.0, abs=1e-6)


def test_what_cannot_be_compared_says_why(trench, parked):
    p = at(trench, 6, 0, 51)
    rows = [
        ("edge", None, "", p),
        ("edge", 25.0, "", p),  # in the swing; with a good clock
        ("edge", 15.0, "", at(trench, 9, 0, 51)),
        ("control", 31.5, "", p),
        ("control", None, "", p),
    ]
    found = found_for(trench, parked, shots_of(rows), tolerance_s=2.0)
    assert found.result.tolist() == [NO_CLOCK, NOT_STILL, ELSEWHERE, NOT_SET_DOWN, NOT_SET_DOWN]
    assert np.isnan(found.difference).all()


def test_a_clock_that_is_seconds_off_finds_the_rest(trench, parked):
    shots = shots_of([("edge", 23.0, "middle", at(trench, 6, 0, 51))])
    assert found_for(trench, parked, shots, tolerance_s=5.0).result.tolist() == [COMPARED]
    assert found_for(trench, parked, shots, tolerance_s=2.5).result.tolist() == [NOT_STILL]


def test_a_known_point_has_a_row_for_each_visit_found_by_where_the_edge_rested(trench):
    t = np.arange(0, 300, 0.1)
    visited = (t % 100 > 20) & (t % 100 < 30)
    h = np.where(visited, 50.0, 51.0)
    edge = trench.edge(t, 4.0, 0.0, h)
    known = {
        "CP 1": KnownPoint(at(trench, 4.02, 0.3, 50.01), 0.003),
        "CP 2": KnownPoint(at(trench, 8, 0, 50), 0.003),
    }
    none = Shots(np.zeros(0, object), np.zeros(0, object), np.zeros((0, 3)))
    shots = with_known_points(none, known, edge, rests_of(edge), 0.15)
    assert shots.point.tolist() == ["CP 1"] * 3 + ["CP 2"]
    assert (
        np.allclose((shots.time_ns[:3] - T0) / 1e9, [25, 125, 225], atol=0.2) and shots.time_ns[3] == NO_TIME
    )
    built = as_built(trench.passes([50.0]), trench.alignment, trench.design, 0.05)
    found = compare_parked(compare(shots, built, trench.alignment, 0.002), shots, edge)
    assert found.result.tolist() == [COMPARED] * 3 + [NOT_SET_DOWN]
    assert np.allclose(found.difference[:3], -0.01, atol=1e-9) and np.allclose(found.sigma_ts, 0.003)
    # Along the alignment the edge stood 2 cm short of the point.
    away = np.column_stack([found.difference_e, found.difference_n])[:3]
    assert np.allclose(away @ [0.6, 0.8], -0.02, atol=1e-6)
    summary = summarise(shots, found, "control")
    assert (summary.n, summary.worst_m) == (3, pytest.approx(-0.01, abs=1e-9))
    assert summary.horizontal_rmse_m == pytest.approx(0.02, abs=1e-6)
    assert summarise(shots, found).n == 0

    # A control row with that id and a time is one visit, at the place of site.toml.
    row = shots_of([("control", 125.0, "", np.zeros(3))])
    row = replace(row, point=np.array(["CP 1"], object))
    one = with_known_points(row, known, edge, rests_of(edge), 0.15)
    assert one.point.tolist() == ["CP 1", "CP 2"] and np.array_equal(one.p_grid[0], known["CP 1"].p_grid)


def test_the_own_part_of_a_mean_is_that_of_a_correlated_series(trench):
    """Against draws of a series whose correlation falls by 1/e in 0.7 s."""
    t = np.arange(0, 4.001, 0.05)
    edge = trench.edge(t, 5.0, 0.0, 50.0, sigma=OWN)
    stand = stand_at(edge, rests_of(edge), 0, T0 + 2 * 10**9, 0.7)
    kernel = np.exp(-np.abs(t[:, None] - t) / 0.7)
    drawn = (
        np.random.default_rng(0).multivariate_normal(np.zeros(len(t)), OWN**2 * kernel, 20_000).mean(axis=1)
    )
    assert np.sqrt(stand.own[1, 2, 2]) == pytest.approx(drawn.std(), rel=0.03)


def test_points_used_in_calibration_stand_in_the_table_and_in_no_statistic(trench, parked):
    p = at(trench, 6, 0, 51)
    rows = [
        ("edge", 15.0, "middle", p + [0, 0, 0.5]),
        ("edge", 15.0, "middle", p),
        ("edge", 15.0, "middle", p),
    ]
    shots = replace(shots_of(rows), code=np.array(["", "CAL old", "CE"], object))
    found = without_used(shots, found_for(trench, parked, shots), ["E0", "CAL"])
    assert found.result.tolist() == [USED, USED, COMPARED]
    assert found.difference[0] == pytest.approx(-0.5, abs=1e-3)
    assert summarise(shots, found, "edge").n == 1 and abs(summarise(shots, found, "edge").bias_m) < 1e-3
