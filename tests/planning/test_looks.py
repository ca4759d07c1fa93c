"""The predicted covariance against what shares no code with it, and against the adjustment's own."""

import numpy as np
import pytest

from pipeline.estimation import adjust
from pipeline.estimation.repeated import Repeated
from pipeline.geometry import linkage
from pipeline.network import Readings
from pipeline.planning.edge import MEASUREMENTS, edge_plan
from pipeline.planning.looks import Looking, looks, raw_reading
from tests.estimation.simulator import SIGMA_PX, T0_NS, observed
from tests.planning.setups import CONSTANT, LOOKING, Forward, network, posture, seen_from


def predicted(net, at, looking=LOOKING, weight=1.0):
    found = looks(net, at, seen_from(net, at), looking)
    return found, edge_plan(found, found.statics_information(weight), looking)


@pytest.mark.parametrize("moved, rate", [(0.0, 0.0), (0.6, 0.4), (-0.5, -0.9)])
def test_one_look_is_the_dense_normal_matrix_by_differences(moved, rate):
    net = network()
    at = posture(net, moved, rate=rate)
    seen = seen_from(net, at).seen
    _, edge = predicted(net, at)
    ours = edge.one_look[0] + edge.common[0]
    other = Forward(net, at, seen).edge_covariance()
    scale = np.sqrt(np.outer(np.diagonal(other), np.diagonal(other)))
    assert seen.sum() > 6
    assert np.abs((ours - other) / scale).max() < 1e-4  # differences of 1e-5 sigma


def test_one_look_is_the_covariance_that_the_adjustment_publishes():
    net = network()
    at = posture(net, 0.3)
    sight = seen_from(net, at)
    _, edge = predicted(net, at)
    _, camera, tag = np.nonzero(sight.seen)
    perfect = observed(
        [(c, t, T0_NS, sight.uv[0, c, t]) for c, t in zip(camera, tag, strict=True)], SIGMA_PX**2
    )
    raw = raw_reading(net, net.sensors[0], at.angle["bucket"])
    tool = adjust(net, perfect, {"pot": Readings(np.array([T0_NS - 20_000_000]), raw)}).body("tool")
    R = tool.T_world_body[0, :3, :3]
    assert edge.p_world[0] == pytest.approx(tool.T_world_body[0, :3, 3], abs=1e-5)
    for ours, theirs in ((edge.one_look, tool.own), (edge.common, tool.common)):
        assert R.T @ ours[0] @ R == pytest.approx(theirs[0, :3, :3], rel=1e-3, abs=1e-3 * ours[0].max())


def test_sources_add_up_to_the_common_part():
    net = network()
    _, edge = predicted(net, posture(net, 0.2, rate=0.5), Looking(repeated=Repeated(), noise=CONSTANT))
    total = sum(v[0] for v in edge.by_source.values())
    assert total == pytest.approx(edge.common[0, 2, 2], rel=1e-9)
    assert (
        min(edge.by_source[s][0] for s in ("benchmarks", "mounts", "cutting edge", "corners", MEASUREMENTS))
        > 0
    )


def test_a_source_that_is_exact_brings_nothing():
    from pipeline.planning.changes import with_better

    net = network()
    _, edge = predicted(with_better(net, "cutting edge", 1e6), posture(net))
    assert edge.by_source["cutting edge"][0] < 1e-15
    _, edge = predicted(with_better(net, "cutting edge", 2.0), posture(net))
    # One look cannot tell the mount of the edge: its 3 mm are halved, whole.
    assert np.sqrt(edge.by_source["cutting edge"][0]) == pytest.approx(0.0015, rel=0.02)


def test_many_looks_teach_the_statics_as_a_dense_solve_says():
    net = network()
    at = posture(net)
    found, _ = predicted(net, at)
    p, n = found.statics.size, 50
    # n states of their own, all statics shared: the whole normal matrix at once.
    b = found.H_xx.shape[1]
    H = np.zeros((n * b + p,) * 2)
    H_zz = np.zeros((p, p))
    for _, J in found.groups:
        for s, A in J.statics.items():
            for t, B in J.statics.items():
                H_zz[np.ix_(found.statics.columns[s], found.statics.columns[t])] += A[0].T @ B[0]
    for k in range(n):
        part = slice(k * b, (k + 1) * b)
        H[part, part] = found.H_xx[0]
        H[part, n * b :] = found.H_xz[0]
        H[n * b :, part] = found.H_xz[0].T
    H[n * b :, n * b :] = n * H_zz + np.eye(p)
    ours = np.linalg.inv(found.statics_information(float(n)))
    assert ours == pytest.approx(np.linalg.inv(H)[n * b :, n * b :], rel=1e-5, abs=1e-8)


def test_a_reading_is_the_inverse_of_the_curve_and_the_linkage():
    net = network()
    angle = np.linspace(-0.6, 0.4, 7)
    raw = raw_reading(net, net.sensors[0], angle)
    c0, c1 = net.statics[net.sensors[0].curve].value
    params = net.statics[net.sensors[0].linkage].value
    assert linkage.bucket_angle(c0 + c1 * raw, params, 1) == pytest.approx(angle, abs=1e-5)


def test_what_no_camera_sees_is_not_told():
    net = network()
    at = posture(net)
    away = posture(net, 30.0)  # the stick far outside every picture
    both = type(at)(
        {k: np.concatenate([at.T_world[k], away.T_world[k]]) for k in at.T_world},
        {k: np.concatenate([at.angle[k], away.angle[k]]) for k in at.angle},
        {k: np.concatenate([at.rate[k], away.rate[k]]) for k in at.rate},
    )
    _, edge = predicted(net, both)
    assert np.isfinite(edge.sigma_h()[0]) and np.isnan(edge.sigma_h()[1])
