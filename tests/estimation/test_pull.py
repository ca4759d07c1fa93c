"""What the motion prior says of the statics is taken off again, and nothing that measurements say."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from benchmarks._drawn_corners import true_statics
from benchmarks.adjustment import corners_drawn, network_drawn
from pipeline.estimation import approach, diagnostics, pull, sweeps
from pipeline.estimation import optimise as iterations
from pipeline.estimation.adjust import adjust, problem_of_log
from pipeline.estimation.linearised import parts, pieces
from pipeline.estimation.marginals import marginals
from pipeline.estimation.normal import linearise, linearise_twice
from pipeline.estimation.optimise import optimise, unpulled
from pipeline.estimation.problem import keep_all
from pipeline.geometry import camera as camera_model
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import _problem

HUBER, NO_LOSS = 2.5, 1e9
DIG = 1


def _log(epochs: int):
    """The log of the benchmark, and its true statics, whitened."""
    network = network_drawn()
    seen = corners_drawn(network, epochs)
    tied = tie(network, seen, {})
    problem = problem_of_log(network, tied, epochs_of(network, seen.take(tied.used), {}))
    truth, statics = true_statics(np.random.default_rng(0), network), problem.statics
    z = np.zeros(statics.size)
    for k, static in enumerate(network.statics):
        base, true = statics.base[k], truth[static.name]
        off = se3.local(base, true) if static.is_pose else true - base
        z[statics.columns[k]] = np.linalg.lstsq(statics.scale[k], off, rcond=None)[0]
    return problem, z


@pytest.fixture(scope="module")
def log():
    return _log(2000)


def _states(problem, z, first=None):
    """All states at their best for these statics, and the cost."""
    held = approach.held(problem, z)
    start = held.first if first is None else replace(first, z=held.first.z)
    values, _, converged, _, cost = iterations._iterate(held, start, keep_all(held, NO_LOSS), 30, 3)
    assert converged
    return replace(values, z=z), cost


def _explained(problem, values, step=1e-3):
    """Degrees of freedom of the corners that their states take up: slope of ``log |H_xx|`` by the corners' weight."""
    held = approach.held(problem, values.z)
    log_det = []
    for share in np.exp([step, -step]):
        heavier = replace(held, corners=tuple(replace(g, share=share * g.share) for g in held.corners))
        cut = parts(heavier, replace(values, z=held.first.z), keep_all(held, NO_LOSS))
        log_det.append(sweeps.reduce(pieces(cut), len(cut)).log_det)
    return (log_det[0] - log_det[1]) / (2 * step)


def test_what_is_taken_off_is_half_the_slope_of_what_the_states_take_up(log):
    """The formula of the pull by noise, from determinants alone, along the two directions that the log tells least."""
    problem, z = log
    states, _ = _states(problem, z)
    cut = parts(problem, states, keep_all(problem, NO_LOSS))
    plain, eased = sweeps.reduce_twice(pieces(cut, ease=pull.EASE), len(cut))
    columns = next(problem.statics.columns[g.intrinsics] for g in problem.corners if g.camera == DIG)
    pulled = (plain.S @ plain.dz - eased.S @ eased.dz)[columns]
    _, directions = np.linalg.eigh(plain.S[np.ix_(columns, columns)])
    for direction in directions.T[:2]:
        explained = []
        for side in (2.0, -2.0):
            moved = z.copy()
            moved[columns] += side * direction
            explained.append(_explained(problem, _states(problem, moved, states)[0]))
        said = 0.5 * (explained[0] - explained[1]) / 4.0
        print(f"pull {direction @ pulled:.4f}, by the determinants {said:.4f}")
        assert direction @ pulled == pytest.approx(said, rel=0.15)


def _reprojected(problem, values):
    """(n, 4, 2) exact corners of these values, per group."""
    out = []
    for g in problem.corners:
        _, T = fr.along(g.path, lambda edge, g=g: values.edge_pose(problem.statics, edge, g.epoch))
        p = se3.transform(np.broadcast_to(T, (len(g.epoch), 4, 4))[:, None], g.p_marker)
        out.append(camera_model.project(p, problem.statics.value(g.intrinsics, values.z)))
    return out


def test_statics_stay_where_exact_corners_put_them_however_stiff_the_motion_prior_is(log):
    """A prior a thousandth as loose pulls by sigmas; nothing measured is off, and the files are right."""
    problem, z = log
    at = replace(problem.first, z=np.zeros(problem.statics.size))
    smooth, _ = _states(problem, z)
    at = replace(smooth, z=at.z)
    stiff = replace(
        problem,
        corners=tuple(
            replace(g, uv=uv) for g, uv in zip(problem.corners, _reprojected(problem, at), strict=True)
        ),
        densities=tuple(1e-3 * q for q in problem.densities),
        first=at,
    )
    optimum = optimise(stiff, NO_LOSS, 40, near=True)
    found = unpulled(stiff, optimum)
    assert optimum.converged and found.eased
    pulled, left = (
        np.abs(o.values.z / np.sqrt(np.diagonal(marginals(stiff, o.values, o.weights, o.eased).P_zz))).max()
        for o in (optimum, found)
    )
    print(f"farthest static off by {pulled:.2f} sigmas, now {left:.3f}")
    assert pulled > 1.0 and left < 0.05


def test_eased_equations_are_those_of_larger_densities_and_of_the_measurements_gradient():
    problem = _problem(draw(5, Options(60, 0.04, 0.04, True)))
    weights = keep_all(problem, HUBER)
    looser = replace(problem, densities=tuple(pull.EASE * q for q in problem.densities))
    free = replace(problem, densities=tuple(1e24 * q for q in problem.densities))
    chains, eased, C, g_z = linearise_twice(problem, problem.first, weights, pull.EASE)
    same = linearise(problem, problem.first, weights)
    of_looser = linearise(looser, problem.first, weights)[0]
    of_free = linearise(free, problem.first, weights)[0]
    np.testing.assert_array_equal(C, same[1])
    np.testing.assert_array_equal(g_z, same[2])
    for chain, plain, ours, loose, alone in zip(chains, same[0], eased, of_looser, of_free, strict=True):
        np.testing.assert_array_equal(chain.D, plain.D)
        scale = np.sqrt(np.einsum("nii->ni", loose.D))
        np.testing.assert_allclose((ours.D - loose.D) / (scale[:, :, None] * scale[:, None]), 0, atol=1e-9)
        np.testing.assert_allclose((ours.A - loose.A) / (scale[:-1, :, None] * scale[1:, None]), 0, atol=1e-9)
        np.testing.assert_allclose(ours.g, alone.g, rtol=1e-6, atol=1e-6 * np.abs(alone.g).max())
        np.testing.assert_array_equal(ours.B, plain.B)


def test_what_measurements_tell_is_not_lost_though_readings_fall_between_pictures():
    """A time offset, which only a moving joint tells, loses most: 2.5 % of its sigma."""
    problem = _problem(draw(5, Options(200, 0.04, 0.04, True, outliers=0.01, blind=((3.0, 3.6),))))
    optimum = optimise(problem, HUBER, 40)
    found = unpulled(problem, optimum)
    assert found.eased and found.last_step_sigmas < 1
    P, P_eased = (marginals(problem, o.values, o.weights, o.eased).P_zz for o in (optimum, found))
    ratio = np.sqrt(np.diagonal(P_eased) / np.diagonal(P))
    print(f"sigmas of statics rise by {100 * (ratio.max() - 1):.1f} % at most")
    assert ratio.min() > 0.999 and ratio.max() < 1.05


def test_an_adjustment_publishes_statics_and_covariances_without_the_pull():
    drawn = draw(5, Options(60, 0.04, 0.04, True))
    problem = _problem(drawn)
    optimum = optimise(problem, HUBER, 60)
    found = unpulled(problem, optimum)
    due = diagnostics.static_results(
        problem, found.values, marginals(problem, found.values, found.weights, eased=True)
    )
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    for ours, one in zip(solution.statics, due, strict=True):
        np.testing.assert_allclose(ours.value, one.value, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.sigma, one.sigma, rtol=1e-6)
    assert np.abs(found.values.z - optimum.values.z).max() > 1e-4


@pytest.mark.slow
def test_errors_of_the_statics_of_a_long_log_are_as_large_as_their_covariances_say(monkeypatch):
    """Two hours at 10 Hz; with the pull the error is 123 where 44 are due, and a principal point 9 sigmas off."""
    problem, z = _log(60_000)
    found = optimise(problem, HUBER, 40)
    monkeypatch.setattr(pull, "LONGER", 0.0)  # the steps that the cost leads
    optimum = optimise(problem, HUBER, 40)
    assert found.eased and not optimum.eased
    cut = parts(problem, found.values, found.weights)
    plain, eased = sweeps.reduce_twice(pieces(cut, ease=pull.EASE), len(cut))
    before, after = optimum.values.z - z, found.values.z - z
    limit = scipy.stats.chi2.ppf(0.975, len(z))
    print(f"NEES {before @ plain.S @ before:.1f}, now {after @ eased.S @ after:.1f} of {len(z)}")
    assert before @ plain.S @ before > 1.5 * limit
    assert after @ eased.S @ after < limit
