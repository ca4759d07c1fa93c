"""What is published, gathered part by part, against the same from the marginals of the log in one piece."""

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.estimation import densities
from pipeline.estimation.marginals import body_track, common_part, marginals, marginals_by_part
from pipeline.estimation.optimise import optimise
from pipeline.estimation.parts import bounds
from pipeline.estimation.published import published
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import _problem


@pytest.fixture(scope="module")
def log():
    problem = _problem(draw(5, Options(90, 0.05, 0.05, True, outliers=0.01, blind=((2.0, 2.6),))))
    settings = EstimationSettings()
    return problem, optimise(problem, settings.huber, settings.max_iterations), settings.max_gap_s


@pytest.fixture
def small_parts(monkeypatch):
    monkeypatch.setattr(
        "pipeline.estimation.optimise.bounds", lambda problem, size=37: bounds(problem, size=size)
    )


def test_states_of_a_log_in_parts_are_those_of_the_log_in_one_piece(log, small_parts):
    problem, optimum, max_gap_s = log
    told = published(problem, optimum, max_gap_s)
    found = marginals(problem, optimum.values, optimum.weights)
    worst = 0.0
    for states in told.states:
        frame = "tool" if states.body == "tool" else f"body {states.body}"
        track = body_track(problem, optimum.values, found, frame, states.body)
        rows = np.searchsorted(problem.epochs.time_ns, states.time_ns)
        np.testing.assert_array_equal(states.T_world_body, track.T_world_body[rows])
        np.testing.assert_array_equal(states.velocity, track.velocity[rows])
        for ours, whole in ((states.own, track.own), (states.common, common_part(track, found.P_zz))):
            sigma = np.sqrt(np.einsum("nii->ni", whole[rows]))
            error = (ours - whole[rows]) / (sigma[:, :, None] * sigma[:, None, :] + 1e-30)
            worst = max(worst, float(np.abs(error).max()))
    print(f"largest difference of a covariance {worst:.1e} of its sigmas")
    assert len(told.states) == 4 and worst < 1e-12
    assert np.isfinite(next(s for s in told.states if s.body == "bucket").sigma_angle_rad).all()


def test_figures_of_a_log_in_parts_are_those_of_the_log_in_one_piece(log, monkeypatch):
    problem, optimum, max_gap_s = log
    whole = published(problem, optimum, max_gap_s)
    monkeypatch.setattr("pipeline.estimation.optimise.bounds", lambda problem: bounds(problem, size=37))
    told = published(problem, optimum, max_gap_s)
    assert told.budget == pytest.approx(whole.budget, rel=1e-4)
    assert told.lasting == pytest.approx(whole.lasting, abs=1e-3) and "median" in told.lasting
    for ours, other in zip(
        told.corner_fits + told.sensor_fits, whole.corner_fits + whole.sensor_fits, strict=True
    ):
        np.testing.assert_array_equal(ours.weight, other.weight)
        np.testing.assert_allclose(ours.r, other.r, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.redundancy, other.redundancy, atol=1e-8)


def test_densities_learned_in_parts_are_those_of_the_log_in_one_piece(log, monkeypatch):
    """And each is the sum over all increments of the trace formula written out, for a body and for a joint."""
    problem, optimum, _ = log
    now = densities.configured(problem, optimum.values)

    def learned():
        sums = densities.Increments(problem, now)
        for part, found in marginals_by_part(problem, optimum.values, optimum.weights):
            sums.add(part, found)
        return sums.learned()

    whole = learned()
    monkeypatch.setattr("pipeline.estimation.optimise.bounds", lambda problem: bounds(problem, size=37))
    for ours, other, before in zip(learned(), whole, now, strict=True):
        np.testing.assert_allclose(ours.density, other.density, rtol=1e-7)
        np.testing.assert_allclose(ours.measured, other.measured, rtol=1e-6, atol=1e-6)
        assert not np.array_equal(other.density, before.density)
