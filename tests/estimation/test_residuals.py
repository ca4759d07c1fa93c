"""Every Jacobian of the adjustment against central differences, in one test."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pipeline.estimation import motion
from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.problem import first_residual, motion_residual
from pipeline.estimation.repeated import Repeated, with_offsets
from pipeline.estimation.residuals import corner_residuals, sensor_residuals
from pipeline.network import Readings
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation.simulator import DRIFTING, Options, draw
from tests.estimation.test_adjust import _problem


def _document():
    """A potentiometer and an angle sensor on the same joint, a marker on the bucket, and a site camera."""
    import copy

    document = copy.deepcopy(DRIFTING)
    document["sensors"]["angle"] = {
        "topic": "/angle",
        "joint": "bucket",
        "curve": {"output": "angle_deg", "coefficients": [1.0, 0.9], "sigma": [0.5, 0.01]},
        "noise": 0.2,
        "sigma_time_offset_s": 0.002,
        "sigma_clock_drift_ppm": 3000.0,
    }
    document["cameras"]["site"] = copy.deepcopy(document["cameras"]["dig"])
    document["cameras"]["site"] |= {
        "body": "world",
        "topic": "/site",
        "mount": {"xyz_m": [3.0, 1.0, 1.5], "rpy_deg": [-90.0, 0.0, 25.0], "sigma_mm": 3.0, "sigma_deg": 0.1},
    }
    return document


@pytest.fixture(scope="module")
def at():
    """A small problem, and values well away from its priors and its optimum."""
    d = draw(5, Options(epochs=5, machine=_document(), bucket_marker=True))
    readings = d.readings | {
        "angle": Readings(d.readings["pot"].time_ns + 7_000_000, np.linspace(-20, -10, 5))
    }
    tied = tie(d.network, d.observations, readings)
    problem = problem_of_log(d.network, tied, epochs_of(d.network, d.observations, readings))
    rng = np.random.default_rng(1)
    E = len(problem.epochs.time_ns)
    deltas = [0.02 * rng.standard_normal((E, v.size)) for v in tied.variables]
    values = problem.first.retract(deltas, 0.7 * rng.standard_normal(problem.statics.size))
    return problem, values


def _nudged(problem, values, variable, component, step):
    deltas = [np.zeros((len(problem.epochs.time_ns), v.size)) for v in problem.tie.variables]
    deltas[variable][:, component] = step
    return values.retract(deltas, np.zeros(problem.statics.size))


def _nudged_static(problem, values, column, step):
    deltas = [np.zeros((len(problem.epochs.time_ns), v.size)) for v in problem.tie.variables]
    dz = np.zeros(problem.statics.size)
    dz[column] = step
    return values.retract(deltas, dz)


def _difference(residual, nudge, h=1e-6):
    return (residual(nudge(h)) - residual(nudge(-h))) / (2 * h)


def _check(analytic, numeric, what):
    scale = np.abs(numeric).max() + 1e-3 * max(np.abs(analytic).max(), 1.0)
    assert np.abs(analytic - numeric).max() < 2e-6 * max(scale, 1.0), what


@pytest.mark.parametrize("kind", ["corner", "sensor"])
def test_measurement_jacobians_match_central_differences(at, kind):
    problem, values = at
    groups = problem.corners if kind == "corner" else problem.sensors
    function = corner_residuals if kind == "corner" else sensor_residuals
    assert groups
    seen_variables, seen_statics = set(), set()
    for group in groups:

        def residual(v, group=group):
            return function(group, v, problem.statics, jacobians=False)[0]

        r, J = function(group, values, problem.statics)
        assert np.isfinite(r).all()
        for k, variable in enumerate(problem.tie.variables):
            given = J.variables.get(k, np.zeros(r.shape + (variable.size,)))
            for i in range(variable.size):
                numeric = _difference(residual, lambda h, k=k, i=i: _nudged(problem, values, k, i, h))
                _check(given[..., i], numeric, (kind, variable.body, i))
        for s, static in enumerate(problem.network.statics):
            columns = problem.statics.columns[s]
            given = J.statics.get(s, np.zeros(r.shape + (len(columns),)))
            for i, column in enumerate(columns):
                numeric = _difference(residual, lambda h, c=column: _nudged_static(problem, values, c, h))
                _check(given[..., i], numeric, (kind, static.name, i))
        seen_variables |= set(J.variables)
        seen_statics |= {problem.network.statics[s].source for s in J.statics}
    assert seen_variables == ({0, 1, 2} if kind == "corner" else {2})
    if kind == "corner":  # the bucket's own clock reaches the corners of its marker
        assert {"benchmarks", "mounts", "intrinsics", "linkage and sensor", "time offset"} <= seen_statics
    else:
        assert {"linkage and sensor", "time offset"} == seen_statics


@pytest.mark.parametrize("k", [0, 1, 2])
def test_motion_jacobians_match_central_differences(at, k):
    problem, values = at
    _, J_1, J_2 = motion_residual(problem, values, k)
    size = problem.tie.variables[k].size

    for J, neighbour in ((J_1, 0), (J_2, 1)):
        for i in range(size):

            def nudge(h, i=i, neighbour=neighbour):
                # Every other epoch, so that each interval has one end moved.
                out = []
                for parity in range(2):
                    deltas = [np.zeros((len(problem.epochs.time_ns), v.size)) for v in problem.tie.variables]
                    deltas[k][parity::2, i] = h
                    out.append(values.retract(deltas, np.zeros(problem.statics.size)))
                return out

            def residual(pair, neighbour=neighbour):
                e = [motion_residual(problem, v, k, jacobians=False)[0] for v in pair]
                first = np.arange(len(e[0])) % 2 == neighbour
                return np.where(first[:, None], e[0], e[1])

            numeric = _difference(residual, nudge, 1e-5)
            scale = np.abs(J).max(axis=(1, 2))[:, None]
            assert np.abs((J[..., i] - numeric) / scale).max() < 1e-7, (k, neighbour, i)


@pytest.mark.parametrize("k", [0, 2])
def test_first_epoch_prior_jacobian_matches_central_differences(at, k):
    problem, values = at
    _, J = first_residual(problem, values, k)
    for i in range(J.shape[1]):
        numeric = _difference(
            lambda v: first_residual(problem, v, k)[0], lambda h, i=i: _nudged(problem, values, k, i, h)
        )
        assert np.abs(J[:, i] - numeric).max() < 1e-6


@pytest.mark.parametrize("v", [0.0, 0.02])
def test_motion_whitening_inverts_the_integrated_white_noise(v):
    dt, a = np.array([1e-4, 0.2, 600.0]), 0.3
    W = motion.whitening(dt, np.full((3, 1, 2), [a, v]))
    for (w00, w10, w11), t in zip(W[:, 0], dt, strict=True):
        Q = a * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]]) + v * np.array([[t, 0], [0, 0]])
        w = np.array([[w00, 0], [w10, w11]])
        np.testing.assert_allclose(w @ Q @ w.T, np.eye(2), atol=1e-9)


def test_motion_residual_is_that_of_gtsam():
    gtsam = pytest.importorskip("gtsam")
    from pipeline.geometry import se3

    rng = np.random.default_rng(0)
    dt, q = 0.3, np.array([0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
    T_1, T_2 = (se3.exp(0.5 * rng.standard_normal(6)) for _ in range(2))
    w_1, w_2 = rng.standard_normal((2, 6))
    e, _, _ = motion.pose_residual(
        T_1[None], w_1[None], T_2[None], w_2[None], np.array([dt]), jacobians=False
    )
    W = motion.whitening(np.array([dt]), np.stack([q, 0 * q], axis=-1)[None])
    ours = motion.whiten(e, W)
    values = gtsam.Values()
    for key, T, w in ((0, T_1, w_1), (1, T_2, w_2)):
        values.insert(key, gtsam.Pose3(T))
        values.insert(key + 10, se3.swap_rotation_first(w))
    ends = gtsam.StateData(0, 10, 0.0), gtsam.StateData(1, 11, dt)
    factor = gtsam.WnoaMotionFactorPose3(*ends, se3.swap_rotation_first(q))
    assert factor.error(values) == pytest.approx(0.5 * float(np.sum(ours**2)), rel=1e-9)


def test_a_tag_with_a_constant_of_its_own_may_be_absent_from_a_part_of_the_log():
    """No rows, and Jacobians of the right width: the main job fell over here when a log was published in parts."""
    drawn = draw(2, Options(epochs=3))
    network = with_offsets(drawn.network, drawn.observations, Repeated())
    tied = tie(network, drawn.observations, drawn.readings)
    epochs = epochs_of(network, drawn.observations.take(tied.used), drawn.readings)
    problem = problem_of_log(network, tied, epochs, Repeated())
    group = problem.corners[0]
    arrays = {f.name: getattr(group, f.name) for f in fields(group)}
    none = replace(group, **{name: a[:0] for name, a in arrays.items() if isinstance(a, np.ndarray)})
    r, J = corner_residuals(none, problem.first, problem.statics)
    assert group.offset is not None and r.shape == (0, 8)
    assert J.statics[group.offset].shape == (0, 8, 8)


def test_statics_of_another_scale_remember_nothing_of_the_old_one():
    statics = _problem(draw(3, Options(3))).statics
    z = np.random.default_rng(1).standard_normal(statics.size)
    before = [statics.value(k, z).copy() for k in range(len(statics.base))]
    wider = replace(statics, scale=tuple(2.0 * scale for scale in statics.scale))
    for k, columns in enumerate(statics.columns):
        assert np.array_equal(statics.value(k, z), before[k])
        assert np.array_equal(wider.value(k, 0.5 * z), before[k])
        assert not len(columns) or not np.array_equal(wider.value(k, z), before[k])
