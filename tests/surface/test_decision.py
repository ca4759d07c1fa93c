"""The guard band's properties, the sigma of a station's mean, the verdict of the job."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.surface.as_built import AsBuilt
from pipeline.surface.decision import (
    CANNOT_TELL,
    FAIL,
    NOT_REACHED,
    PASS,
    ToleranceBand,
    decide,
    job_verdict,
    judge,
    stations_along,
)
from pipeline.surface.sweep import CellGrid

repeatable = settings(derandomize=True, deadline=None)
small = st.floats(0, 0.1)
deviations = st.floats(-0.3, 0.3)


@repeatable
@given(deviations, small, small, small)
def test_pass_means_the_whole_interval_is_inside_and_fail_that_it_is_outside(deviation, u, high, low):
    verdict, reason = decide(deviation, u, ToleranceBand(high, low))
    inside = deviation - u >= -low and deviation + u <= high
    outside = deviation - u > high or deviation + u < -low
    assert verdict == (PASS if inside else FAIL if outside else CANNOT_TELL)
    assert reason


@repeatable
@given(deviations, small, small, small)
def test_under_dug_and_over_dug_are_mirror_images(deviation, u, high, low):
    one, other = (
        decide(deviation, u, ToleranceBand(high, low)),
        decide(-deviation, u, ToleranceBand(low, high)),
    )
    assert one[0] == other[0]
    if one[0] == FAIL:
        assert ("under-dug" in one[1]) == ("over-dug" in other[1])


@repeatable
@given(deviations, small, st.floats(0, 0.05), small, small)
def test_knowing_less_never_turns_cannot_tell_into_a_verdict(deviation, u, more, high, low):
    band = ToleranceBand(high, low)
    before, after = decide(deviation, u, band)[0], decide(deviation, u + more, band)[0]
    assert after in (before, CANNOT_TELL)


@repeatable
@given(deviations, small, small, small, small, small)
def test_a_wider_tolerance_never_fails_what_passed(deviation, u, high, low, a, b):
    if decide(deviation, u, ToleranceBand(high, low))[0] == PASS:
        assert decide(deviation, u, ToleranceBand(high + a, low + b))[0] == PASS


def test_a_measurement_that_cannot_show_conformity_says_so_and_still_sees_a_gross_error():
    band = ToleranceBand(0.02, 0.03)
    verdict, reason = decide(0.0, 0.0251, band)
    assert verdict == CANNOT_TELL and reason.startswith("measurement not capable: U 25.1 mm")
    assert decide(0.005, 0.024, band)[1] == "the upper limit of the tolerance lies within deviation ± U"
    assert decide(-0.010, 0.024, band)[1] == "the lower limit of the tolerance lies within deviation ± U"
    verdict, reason = decide(0.2, 0.05, band)
    assert verdict == FAIL and "high by at least 130.0 mm" in reason


def test_positive_is_high_and_under_dug():
    assert "under-dug" in decide(+0.1, 0.0, ToleranceBand(0.02, 0.02))[1]
    assert "over-dug" in decide(-0.1, 0.0, ToleranceBand(0.02, 0.02))[1]


def surface(trench, deviation, own=0.0, common=0.0, time_s=0.0, cut=True, one_pass=None):
    """A surface over the whole trench of the given deviation, cells of 0.1 m; arguments broadcast to its cells."""
    grid = CellGrid(0.1, 0.0, -0.5, 100, 10)
    shape = (100, 10)
    cut = np.broadcast_to(cut, shape)
    full = lambda value: np.where(cut, np.broadcast_to(value, shape), np.nan)  # noqa: E731
    return AsBuilt(
        grid=grid,
        state=np.where(cut, 2, 0).astype(np.uint8),
        floor=np.ones(shape, bool),
        h=full(50.0 + np.asarray(deviation)),
        h_lowest=full(50.0 + np.asarray(deviation)),
        design_h=np.full(shape, 50.0),
        sigma_own=full(own),
        sigma_common=full(common),
        sigma_pass=full(own if one_pass is None else one_pass),
        passes=cut.astype(np.int32),
        lowest_time_ns=np.broadcast_to(np.round(np.asarray(time_s) * 1e9).astype(np.int64), shape),
        excess_m=np.zeros(0),
        excess_share=np.zeros(0),
    )


BAND = ToleranceBand(0.02, 0.02)


def judged(trench, built, step=0.5, band=BAND):
    station = (np.arange(round(10.0 / step)) + 0.5) * step  # whole pieces, none cut short at an end
    return judge(built, trench.design, station, step, band)


def test_cells_told_by_the_same_passes_share_their_errors(trench):
    # Three passes of 6 mm tell every cell to 3.5 mm; each of them is the lowest in a third of the cells. The mean of a
    # station is the mean of the three: 3.5 mm, not a third of three independent means of 3.5 mm.
    third = np.arange(1000).reshape(100, 10) % 3 * 10.0
    built = surface(trench, 0.0, own=0.006 / np.sqrt(3), one_pass=0.006, time_s=third)
    assert judged(trench, built).sigma_own == pytest.approx(0.006 / np.sqrt(3), rel=2e-3)
    # One sweep that is everywhere the lowest is no worse than its cells.
    built = surface(trench, 0.0, own=0.006 / np.sqrt(3), one_pass=0.006)
    assert judged(trench, built).sigma_own == pytest.approx(0.006 / np.sqrt(3), rel=1e-9)


def test_stations_are_the_whole_multiples_of_the_step_that_the_design_reaches(trench):
    assert stations_along(trench.design, -5.0, 2.0, 0.5).tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert stations_along(trench.design, 1.2, 2.0, 0.5).tolist() == [1.0, 1.5, 2.0]
    assert len(stations_along(trench.design, 0.0, 10.0, 0.1)) == 101


def test_a_station_is_the_mean_of_its_cells(trench):
    rng = np.random.default_rng(0)
    deviation = rng.normal(0, 0.01, (100, 10))
    stations = judged(trench, surface(trench, deviation))
    assert np.allclose(stations.deviation, deviation.reshape(20, 50).mean(axis=1), rtol=0, atol=1e-12)
    assert np.all(stations.cells_cut == 50) and np.all(stations.cells_floor == 50)
    assert np.allclose(stations.width, 1.0)


def test_the_common_part_is_not_reduced_by_averaging(trench):
    stations = judged(trench, surface(trench, 0.0, own=0.0, common=0.004))
    assert np.allclose(stations.sigma_common, 0.004)
    assert np.allclose(stations.expanded_uncertainty, 0.008)


def test_the_own_part_shrinks_with_the_number_of_sweeps_and_not_of_cells(trench):
    one = judged(trench, surface(trench, 0.0, own=0.006, time_s=0.0))
    assert np.allclose(one.sigma_own, 0.006)
    four = np.tile(np.repeat([0.0, 10, 20, 30], [3, 2, 3, 2]), (100, 1))
    several = judged(trench, surface(trench, 0.0, own=0.006, time_s=four))
    assert np.allclose(several.sigma_own, 0.006 * np.sqrt(0.3**2 + 0.2**2 + 0.3**2 + 0.2**2))


def test_the_own_sigma_of_a_station_predicts_its_scatter(trench):
    rng = np.random.default_rng(1)
    sweeps = np.tile(np.repeat([0, 1], 5), (100, 1))
    z = []
    for _ in range(1500):
        error = rng.normal(0, 0.005, 2)[sweeps]
        built = surface(trench, error, own=0.005, time_s=sweeps * 10.0)
        one = judge(built, trench.design, np.array([3.25]), 0.5, BAND)
        z.append(one.deviation[0] / one.sigma_own[0])
    assert np.std(z) == pytest.approx(1.0, abs=0.06)  # 1,500 draws tell it to 0.018


def test_stations_without_enough_cut_floor_are_not_reached(trench):
    share = np.repeat([0.0, 0.2, 0.3, 0.8, 1.0], 20)
    cut = np.arange(10) < 10 * share[:, None]
    stations = judged(trench, surface(trench, 0.0, cut=cut), step=2.0)
    assert stations.state.tolist() == ["not reached", "not reached", "partly cut", "cut", "cut"]
    assert stations.verdict.tolist() == [NOT_REACHED, NOT_REACHED, CANNOT_TELL, PASS, PASS]
    assert stations.reason[1] == "40 of 200 floor cells cut, at least 25% are needed"
    assert stations.reason[2] == "the part that was cut is within tolerance; 30% of the floor was cut"
    assert np.isnan(stations.deviation[:2]).all() and np.all(stations.design_h == 50)


@pytest.mark.parametrize(
    "levels, verdict, words",
    [
        ([0, 0, 0, 0, 0], PASS, "All 5 stations that were wholly cut are within tolerance."),
        ([0, 0.1, 0, 0, 0], FAIL, "1 of 5 reached stations are out of tolerance."),
        ([0, 0.018, 0, 0, 0], CANNOT_TELL, "1 of 5 reached stations cannot be told, none fails."),
        ([0.018, 0.1, 0, 0, 0], FAIL, "out of tolerance"),
        (
            [np.nan, 0, 0, 0, 0],
            PASS,
            "All 4 stations that were wholly cut are within tolerance; 1 of 5 stations were not reached.",
        ),
        (
            [0, np.nan, 0, 0, 0],
            CANNOT_TELL,
            "0 of 4 reached stations cannot be told, none fails; 1 between them were not cut; 1 of 5 stations",
        ),
        ([np.nan] * 5, CANNOT_TELL, "No station was reached"),
    ],
)
def test_the_job_fails_with_one_station_and_passes_with_all(trench, levels, verdict, words):
    level = np.repeat(levels, 20)[:, None]
    built = surface(trench, np.nan_to_num(level), own=0.002, cut=np.isfinite(level))
    job = job_verdict(judged(trench, built, step=2.0))
    assert job.verdict == verdict and words in job.sentence
    assert sum(job.counts.values()) == 5


def test_high_ground_in_the_middle_of_a_trench_keeps_the_job_from_passing(trench):
    """Ground that stays 350 mm high is passed over, not cut; what was cut beside it does not speak for it."""
    share = np.repeat([0.5, 1.0, 0.3, 1.0, 0.5], 20)
    cut = np.arange(10) < 10 * share[:, None]
    job = job_verdict(judged(trench, surface(trench, 0.0, cut=cut), step=2.0))
    assert job.verdict == CANNOT_TELL
    share[40:60] = 1.0
    job = job_verdict(judged(trench, surface(trench, 0.0, cut=np.arange(10) < 10 * share[:, None]), step=2.0))
    assert job.verdict == PASS and "2 at the ends were cut in part only" in job.sentence
