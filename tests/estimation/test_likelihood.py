"""The marginal likelihood against the density of the measurements themselves, by dense algebra; and that it rises."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation import adjust
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.likelihood import log_likelihood, log_volume
from pipeline.estimation.marginals import marginals
from pipeline.estimation.optimise import optimise
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import dense
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import NO_LOSS
from tests.estimation.test_densities import _wrong_by


@pytest.fixture(scope="module", params=["potentiometer", "bucket marker"])
def problem(request):
    kind = request.param == "potentiometer"
    drawn = draw(5, Options(epochs=4, potentiometer=kind, bucket_marker=not kind))
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    epochs = epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    return problem_of_log(drawn.network, tied, epochs)


def test_it_is_the_density_of_the_measurements_with_everything_else_integrated_out(problem):
    """No factorisation of ours: the measurements are normal with covariance ``1 + A P A'`` about what the priors say.

    ``A`` are the rows of the measurements, ``P`` the covariance of the priors, both linearised at the optimum. With
    other densities of motion it is another figure, by as much.
    """
    told = []
    for factor in (1.0, 9.0):
        trial = replace(problem, densities=tuple(factor * q for q in problem.densities))
        at = optimise(trial, NO_LOSS, 30)
        r, J, _ = dense.jacobian(trial, at.values)
        measured = sum(8 * len(g.epoch) for g in trial.corners) + sum(len(s.epoch) for s in trial.sensors)
        A, prior = J[:measured], J[measured:]
        assert prior.shape[0] == prior.shape[1]
        scale = np.linalg.norm(prior, axis=0)
        to_states = np.linalg.inv(prior / scale) / scale[:, None]
        off = r[:measured] - A @ (to_states @ r[measured:])
        covariance = np.eye(measured) + (A @ to_states) @ (A @ to_states).T
        whitened = np.linalg.slogdet(covariance)[1] + off @ np.linalg.solve(covariance, off)
        log_whitener = sum(np.linalg.slogdet(g.whitener)[1].sum() for g in trial.corners)
        log_whitener -= sum(np.log(s.sigma).sum() for s in trial.sensors)
        expected = -0.5 * (whitened + measured * np.log(2 * np.pi)) + log_whitener
        volume = np.linalg.slogdet(prior / scale)[1] + np.log(scale).sum()
        assert log_volume(trial, at.values) == pytest.approx(volume, abs=1e-6)
        log_det = marginals(trial, at.values, at.weights).log_det
        _, R = np.linalg.qr(J / np.linalg.norm(J, axis=0))
        dense_log_det = 2 * (np.log(np.abs(np.diagonal(R))).sum() + np.log(np.linalg.norm(J, axis=0)).sum())
        assert log_det == pytest.approx(dense_log_det, rel=1e-10)
        ours = log_likelihood(trial, at, log_det)
        print(f"densities x {factor:.0f}: log likelihood {ours:.6f}, dense {expected:.6f}")
        # A last step of 0.05 sigma is 1e-3 of the cost; the linearisation is the same in both.
        assert ours == pytest.approx(expected, abs=2e-3)
        told.append(ours)
    assert abs(told[1] - told[0]) > 5


@pytest.mark.parametrize("factor", [30.0, 1 / 30])
def test_it_rises_from_round_to_round(factor):
    drawn = draw(21, Options(epochs=120, frame_s=0.1, reading_s=0.1))
    solution = adjust(_wrong_by(drawn, factor), drawn.observations, drawn.readings, learn=True)
    rounds = solution.diagnostics["learned"]["log_likelihood"]
    right = adjust(drawn.network, drawn.observations, drawn.readings).diagnostics["log_likelihood"]
    print(f"densities x {factor:.2g}: log likelihood {rounds}, with the true densities {right}")
    assert len(rounds) == solution.diagnostics["learned"]["rounds"] + 1
    assert np.all(np.diff(rounds) > -0.5)
    assert rounds[-1] > rounds[0] + 50
    assert rounds[-1] > right - 5
    assert rounds[-1] == solution.diagnostics["log_likelihood"]
