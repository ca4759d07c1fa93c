"""Benchmarks predicted without their survey, and odd against even frames: against adjustments made anew."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation import validation
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.marginals import marginals
from pipeline.estimation.optimise import optimise
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import Options, draw


def _solved(drawn):
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    epochs = epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    problem = problem_of_log(drawn.network, tied, epochs)
    return problem, optimise(problem, 2.5, 60)


def test_a_benchmark_left_out_is_where_an_adjustment_without_its_survey_puts_it():
    """The same log with that survey a hundred million times as uncertain."""
    drawn = draw(3, Options(epochs=20))
    problem, optimum = _solved(drawn)
    said = validation.left_out(problem, optimum.values, marginals(problem, optimum.values, optimum.weights))
    k = next(i for i, s in enumerate(drawn.network.statics) if s.name == "benchmark B2 pose")
    statics = list(drawn.network.statics)
    file_covariance = statics[k].covariance
    statics[k] = replace(statics[k], covariance=1e8 * file_covariance)
    free, again = _solved(replace(drawn, network=replace(drawn.network, statics=tuple(statics))))
    columns, scale = free.statics.columns[k], free.statics.scale[k]
    R = statics[k].value[:3, :3]
    expected = 1000 * R @ (scale @ again.values.z[columns])[:3]
    P = scale @ marginals(free, again.values, again.weights).P_zz[np.ix_(columns, columns)] @ scale.T
    sigma = 1000 * np.sqrt(np.diagonal(R @ (P + file_covariance)[:3, :3] @ R.T))
    print(f"\nB2 {said['B2']['difference_mm']} and {expected}, sigma {said['B2']['sigma_mm']} and {sigma}")
    assert said["B2"]["sigma_mm"] == pytest.approx(sigma, rel=0.01)
    assert np.abs(said["B2"]["difference_mm"] - expected).max() < 0.1 * sigma.min()


def test_the_differences_of_left_out_benchmarks_are_as_large_as_their_sigmas_say():
    normalised = []
    for seed in range(10):
        problem, optimum = _solved(draw(seed, Options(epochs=8)))
        said = validation.left_out(
            problem, optimum.values, marginals(problem, optimum.values, optimum.weights)
        )
        normalised += [one["normalised"] for one in said.values()]
    mean = float(np.mean(np.square(normalised)))
    print(
        f"\nmean squared difference of {len(normalised)} benchmarks left out, in sigmas: {mean:.2f}, 3 is right"
    )
    assert 1.7 < mean < 4.5  # benchmarks of one log are correlated: some 20 of the 30 count


def test_odd_and_even_frames_disagree_as_much_as_was_predicted():
    """Drawn motion is that of the prior; noise twice as large as stated doubles the disagreement that corners make."""
    ratios, inside = [], 0
    for seed in range(6):
        problem, optimum = _solved(draw(seed, Options(epochs=40, potentiometer=False, bucket_marker=True)))
        said = validation.odd_even(
            problem, optimum.values, optimum.weights, np.ones(len(problem.epochs.time_ns), dtype=bool)
        )
        ratios.append(said["ratio"])
        inside += said["ratio_95"][0] <= said["ratio"] <= said["ratio_95"][1]
    print(f"\nobserved over predicted: {ratios}, {inside} of 6 inside")
    assert inside >= 4
    assert 0.6 < float(np.median(ratios)) < 1.6
