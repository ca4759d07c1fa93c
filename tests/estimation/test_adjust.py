"""The whole adjustment: its optimum, its covariances, and what must not throw it."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from pipeline.config.site import EstimationSettings
from pipeline.errors import NetworkError
from pipeline.estimation import adjust
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.marginals import body_track, common_part, marginals
from pipeline.estimation.normal import linearise
from pipeline.estimation.optimise import optimise
from pipeline.estimation.problem import first_residual, keep_all, motion_residual
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.geometry import se3
from pipeline.network import Readings
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import dense
from tests.estimation.simulator import MACHINE, SITE, Options, draw

NO_LOSS = 1e6
"""A Huber threshold that nothing reaches: plain least squares."""


def _problem(drawn):
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    return problem_of_log(
        drawn.network, tied, epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    )


@pytest.fixture(scope="module", params=["potentiometer", "bucket marker", "both"])
def solved(request):
    """A small network of each kind at its optimum."""
    options = Options(
        epochs=2,
        bucket_marker=request.param != "potentiometer",
        potentiometer=request.param != "bucket marker",
    )
    problem = _problem(draw(2, options))
    optimum = optimise(problem, NO_LOSS, 30)
    assert optimum.converged
    return problem, optimum


def _vector(problem, values):
    """All whitened residuals as one vector."""
    parts = [
        corner_residuals(g, values, problem.statics, jacobians=False)[0].ravel() for g in problem.corners
    ]
    parts += [
        sensor_residuals(s, values, problem.statics, jacobians=False)[0].ravel() for s in problem.sensors
    ]
    for k in range(len(problem.tie.variables)):
        parts += [
            motion_residual(problem, values, k, jacobians=False)[0].ravel(),
            first_residual(problem, values, k)[0],
        ]
    return np.concatenate([*parts, values.z])


def _moved(problem, values, x):
    """Values moved by a dense step, in the order of ``dense.assemble``."""
    E = len(problem.epochs.time_ns)
    deltas, at = {}, 0
    for c, members in enumerate(problem.chains):
        b = problem.chain_size(c)
        block = x[at : at + E * b].reshape(E, b)
        at += E * b
        for k in members:
            deltas[k] = block[:, problem.place(k)[1]]
    return values.retract([deltas[k] for k in range(len(deltas))], x[at:])


def test_the_optimum_is_that_of_a_dense_gauss_newton_by_differences(solved):
    """From one sigma away in every unknown at once, with central differences instead of our derivatives."""
    problem, optimum = solved
    H, _, _ = dense.assemble(*linearise(problem, optimum.values, keep_all(problem, NO_LOSS)))
    sigma = np.sqrt(np.diagonal(dense.inverse(H)))
    scale = 1 / np.sqrt(np.diagonal(H))
    values = _moved(problem, optimum.values, sigma * np.random.default_rng(0).choice([-1, 1], len(H)))
    for _ in range(4):
        J = np.empty((len(_vector(problem, values)), len(H)))
        for i in range(len(H)):
            x = np.zeros(len(H))
            x[i] = 1e-3 * scale[i]
            J[:, i] = (
                _vector(problem, _moved(problem, values, x)) - _vector(problem, _moved(problem, values, -x))
            ) / 2e-3
        step = -np.linalg.lstsq(J, _vector(problem, values), rcond=None)[0]
        values = _moved(problem, values, scale * step)
    assert optimum.cost == pytest.approx(0.5 * np.sum(_vector(problem, values) ** 2), rel=1e-7)
    sigma_z = np.sqrt(np.diagonal(marginals(problem, optimum.values, keep_all(problem, NO_LOSS)).P_zz))
    assert np.abs((values.z - optimum.values.z) / sigma_z).max() < 0.02
    for ours, other in zip(optimum.values.pose, values.pose, strict=True):
        assert np.abs(ours - other).max() < 1e-4


def test_marginals_of_states_and_statics_equal_a_dense_inverse(solved):
    problem, optimum = solved
    weights = keep_all(problem, NO_LOSS)
    chains, C, g_z = linearise(problem, optimum.values, weights)
    H, _, starts = dense.assemble(chains, C, g_z)
    P = dense.inverse(H)
    found = marginals(problem, optimum.values, weights)
    sigma = np.sqrt(np.diagonal(P))
    n = starts[-1]
    for c, start in enumerate(starts[:-1]):
        E, b = chains[c].g.shape
        Y, q = found.Y[c], found.columns[c]
        for k in range(E):
            at = slice(start + k * b, start + (k + 1) * b)
            whole = found.Z[c][k] + Y[k] @ found.P_zz[np.ix_(q, q)] @ Y[k].T
            assert np.abs((whole - P[at, at]) / np.outer(sigma[at], sigma[at])).max() < 1e-8
    assert np.abs((found.P_zz - P[n:, n:]) / np.outer(sigma[n:], sigma[n:])).max() < 1e-8


@pytest.mark.parametrize("body", ["cab", "stick", "bucket", "tool"])
def test_the_covariance_of_a_composed_body_is_that_of_the_dense_inverse(solved, body):
    problem, optimum = solved
    weights = keep_all(problem, NO_LOSS)
    H, _, _ = dense.assemble(*linearise(problem, optimum.values, weights))
    P = dense.inverse(H)
    found = marginals(problem, optimum.values, weights)
    frame = body if body == "tool" else f"body {body}"
    track = body_track(problem, optimum.values, found, frame, body)
    whole = track.own + common_part(track, found.P_zz)
    E, h = len(problem.epochs.time_ns), 1e-5

    def pose(x):
        return body_track(problem, _moved(problem, optimum.values, x), found, frame, body).T_world_body

    J = np.zeros((E, 6, len(H)))
    for i in range(len(H)):
        x = np.zeros(len(H))
        x[i] = h
        J[:, :, i] = se3.local(pose(-x), pose(x)) / (2 * h)
    expected = J @ P @ np.swapaxes(J, -1, -2)
    sigma = np.sqrt(np.einsum("nii->ni", expected))
    # Limited by the differences, not by the algebra.
    assert np.abs((whole - expected) / (sigma[:, :, None] * sigma[:, None])).max() < 1e-5


def test_velocities_are_the_rates_of_the_composed_poses():
    drawn = draw(4, Options(epochs=40))
    tool = adjust(drawn.network, drawn.observations, drawn.readings).body("tool")
    t = (tool.time_ns - tool.time_ns[0]) * 1e-9
    dt = t[2:] - t[:-2]
    rate = se3.local(tool.T_world_body[:-2], tool.T_world_body[2:]) / dt[:, None]
    middle = tool.velocity[1:-1]
    assert np.abs(rate - middle)[5:-5].max() < 0.05
    assert np.abs(middle).max() > 0.1


def test_gross_corners_are_rejected_and_the_rest_stands():
    clean, dirty = draw(6, Options(epochs=30)), draw(6, Options(epochs=30, outliers=0.02))
    solution = adjust(dirty.network, dirty.observations, dirty.readings)
    assert solution.diagnostics["converged"]
    thrown = np.isin(dirty.observations.uv, clean.observations.uv, invert=True).any(axis=-1)
    assert thrown.sum() > 20
    weight = solution.residuals.weight
    assert np.sum(weight == 0) >= 0.9 * thrown.sum()
    assert np.sum(weight == 0) <= 1.1 * thrown.sum() + 5
    tool = solution.body("tool")
    error, rows = dirty.error(tool)
    P = (tool.own + tool.common)[rows]
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error).mean() < 16.8  # 99 % of chi-square, 6


def test_states_in_a_gap_are_bridged_with_wider_covariances():
    machine = copy.deepcopy(MACHINE)
    machine["motion"]["bucket"]["rotation"] = 2e-4  # twelve seconds within the stroke of the linkage
    drawn = draw(7, Options(epochs=60, blind=((4.0, 8.0),), machine=machine))
    solution = adjust(drawn.network, drawn.observations, drawn.readings, EstimationSettings(max_gap_s=0.5))
    assert solution.diagnostics["converged"]
    cab = solution.body("cab")
    t = (cab.time_ns - drawn.frame_ns[0]) * 1e-9
    inside = (t > 4.4) & (t < 7.3)
    assert not cab.seen[inside].any() and cab.seen[(t < 3.5) | (t > 8.5)].all()
    sigma = np.sqrt(np.einsum("nii->n", cab.own[:, :3, :3]))
    assert sigma[inside].max() > 3 * np.median(sigma[cab.seen])
    error, rows = drawn.error(cab)
    z = error / np.sqrt(np.einsum("nii->ni", (cab.own + cab.common)[rows]))
    assert np.abs(z).max() < 4.5


def test_an_edge_is_seen_only_where_every_link_to_the_datum_is():
    """The cab sees its benchmarks all the time; for four seconds the stick's marker is hidden."""
    drawn = draw(9, Options(epochs=60))
    seen, t_ns = drawn.observations, drawn.frame_ns[0]
    on_stick = (
        np.array([m.name for m in drawn.network.markers])[drawn.network.tag_marker[seen.tag]] == "stick"
    )
    hidden = on_stick & (seen.time_ns >= t_ns + 4 * 10**9) & (seen.time_ns < t_ns + 8 * 10**9)
    assert hidden.any()
    solution = adjust(drawn.network, seen.take(~hidden), drawn.readings, EstimationSettings(max_gap_s=0.5))
    tool, cab = solution.body("tool"), solution.body("cab")
    t = (tool.time_ns - t_ns) * 1e-9
    assert not tool.seen[(t > 4.4) & (t < 7.3)].any() and tool.seen[(t < 3.5) | (t > 8.5)].all()
    assert cab.seen.all()


@pytest.mark.parametrize("frames", [1, 2])
def test_a_log_of_one_frame_has_an_answer(frames):
    drawn = draw(8, Options(epochs=frames, bucket_marker=True, potentiometer=False))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    tool = solution.body("tool")
    assert len(tool.time_ns) == frames
    error, _ = drawn.error(tool)
    assert np.abs(error[:, :3]).max() < 0.1


def test_duplicate_and_nearly_equal_stamps_change_next_to_nothing():
    drawn = draw(9, Options(epochs=20))
    base = adjust(drawn.network, drawn.observations, drawn.readings).body("tool")
    seen = drawn.observations
    twice = seen.take(np.r_[np.arange(len(seen.camera)), np.arange(50)])
    late = replace(
        twice, time_ns=twice.time_ns + 40_000 * (twice.camera == 1)
    )  # the second camera 40 us late
    pot = drawn.readings["pot"]
    pot = Readings(np.r_[pot.time_ns, pot.time_ns[:5]], np.r_[pot.raw, pot.raw[:5]])
    solution = adjust(drawn.network, late, {"pot": pot})
    assert solution.diagnostics["dropped"]["tag seen twice at one instant"] == 50
    assert solution.diagnostics["dropped"]["reading of 'pot' with a stamp that was there before"] == 5
    other = solution.body("tool")
    assert len(other.time_ns) == len(base.time_ns)
    assert np.abs(se3.local(base.T_world_body, other.T_world_body)).max() < 1e-4


def test_readings_a_millisecond_from_a_frame_share_its_epoch_and_stay_exact():
    drawn = draw(10, Options(epochs=20))
    pot = drawn.readings["pot"]
    offset_ns = round(0.02 * 1e9)
    near = Readings(
        drawn.frame_ns - offset_ns + 300_000,
        np.interp(drawn.frame_ns + 300_000, pot.time_ns + offset_ns, pot.raw),
    )
    solution = adjust(drawn.network, drawn.observations, {"pot": near})
    assert solution.diagnostics["epochs"] == len(drawn.frame_ns)
    assert solution.diagnostics["converged"]


def test_a_pause_of_minutes_does_not_break_the_numbers():
    drawn = draw(11, Options(epochs=30))
    half = drawn.frame_ns[15]
    pause = 600_000_000_000
    seen, pot = drawn.observations, drawn.readings["pot"]
    seen = replace(seen, time_ns=seen.time_ns + pause * (seen.time_ns >= half))
    pot = Readings(pot.time_ns + pause * (pot.time_ns >= half), pot.raw)
    solution = adjust(drawn.network, seen, {"pot": pot})
    assert solution.diagnostics["converged"]
    for states in solution.states:
        for part in (states.own, states.common):
            assert np.isfinite(part).all()
            assert np.linalg.eigvalsh(part).min() > -1e-9 * np.abs(part).max()


def test_a_time_offset_that_no_second_clock_sees_stays_at_its_file_value():
    drawn = draw(12, Options(epochs=40))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    offset = next(s for s in solution.statics if s.quantity == "sensor pot time offset")
    assert abs(offset.shift_sigmas[0]) < 1e-9
    assert offset.sigma[0] == pytest.approx(offset.prior_sigma[0])


def test_exact_statics_are_left_out_of_the_unknowns():
    from tests.estimation.simulator import exact

    machine = exact(copy.deepcopy(MACHINE))
    drawn = draw(13, Options(epochs=10, machine=machine, site=exact(copy.deepcopy(SITE))))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    assert solution.diagnostics["unknowns"]["statics"] == 0
    assert np.abs(solution.body("tool").common).max() == 0


def test_the_budget_adds_up_to_the_variance_of_the_elevation():
    drawn = draw(14, Options(epochs=10))
    solution = adjust(drawn.network, drawn.observations, drawn.readings)
    tool = solution.body("tool")
    up = tool.T_world_body[:, 2, :3]
    whole = np.einsum("ni,nij,nj->n", up, (tool.own + tool.common)[:, :3, :3], up)
    budget = solution.diagnostics["error_budget"]
    assert set(budget) == {
        "own", "statics from measurements", "benchmarks", "mounts", "intrinsics", "linkage and sensor",
        "cutting edge", "time offset",
    }  # fmt: skip
    # Medians of parts, so equal only as far as the epochs are alike.
    assert sum(v**2 for v in budget.values()) == pytest.approx(np.median(whole), rel=0.1)


def test_a_stick_that_nobody_sees_is_named():
    drawn = draw(15, Options(epochs=5))
    seen = drawn.observations
    boards_only = seen.take(
        np.array([drawn.network.markers[m].benchmark for m in drawn.network.tag_marker])[seen.tag]
    )
    with pytest.raises(NetworkError, match=r"body 'stick' is not tied to the datum.*let a camera"):
        adjust(drawn.network, boards_only, drawn.readings)


def test_the_same_log_twice_gives_the_same_bytes():
    drawn = draw(16, Options(epochs=10))
    first, second = (adjust(drawn.network, drawn.observations, drawn.readings) for _ in range(2))
    assert first.diagnostics == second.diagnostics
    for a, b in zip(first.states, second.states, strict=True):
        assert a.T_world_body.tobytes() == b.T_world_body.tobytes()
        assert a.common.tobytes() == b.common.tobytes()


def test_a_motion_prior_that_is_too_stiff_is_named():
    machine = copy.deepcopy(MACHINE)
    machine["motion"]["bucket"]["rotation"] = 0.1
    drawn = draw(17, Options(epochs=10, machine=machine))
    bodies = dict(drawn.network.bodies)
    bodies["bucket"] = replace(bodies["bucket"], motion=(1.0, 1e-3))
    stiff = adjust(replace(drawn.network, bodies=bodies), drawn.observations, drawn.readings)
    assert any("motion.bucket.rotation" in w for w in stiff.warnings)
    right = adjust(drawn.network, drawn.observations, drawn.readings)
    assert not any("motion." in w for w in right.warnings)
