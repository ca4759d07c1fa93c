"""Own and common part of every covariance, apart, against dense algebra without normal equations or blocks."""

import numpy as np
import pytest

from pipeline.estimation.adjust import problem_of_log
from pipeline.estimation.marginals import body_track, common_part, marginals
from pipeline.estimation.optimise import optimise
from pipeline.estimation.problem import keep_all
from pipeline.geometry import se3
from pipeline.network import frames as fr
from pipeline.network.datum import tie
from pipeline.network.epochs import epochs_of
from tests.estimation import dense
from tests.estimation.simulator import DRIFTING, MACHINE, Options, draw
from tests.estimation.test_adjust import NO_LOSS, _moved


@pytest.fixture(scope="module", params=["potentiometer", "bucket marker", "both", "drift"])
def solved(request):
    """A small network at its optimum: problem, values, our marginals, and the dense parts."""
    options = Options(
        epochs=3,
        bucket_marker=request.param != "potentiometer",
        potentiometer=request.param != "bucket marker",
        machine=DRIFTING if request.param == "drift" else MACHINE,
    )
    drawn = draw(3, options)
    tied = tie(drawn.network, drawn.observations, drawn.readings)
    epochs = epochs_of(drawn.network, drawn.observations.take(tied.used), drawn.readings)
    problem = problem_of_log(drawn.network, tied, epochs)
    values = optimise(problem, NO_LOSS, 30).values
    _, J, n = dense.jacobian(problem, values)
    return problem, values, marginals(problem, values, keep_all(problem, NO_LOSS)), dense.own_and_common(J, n)


def _off(ours, dense_part, sigma):
    """Largest difference in units of both sigmas."""
    return np.abs((ours - dense_part) / (sigma[..., :, None] * sigma[..., None, :])).max()


def test_both_parts_of_every_state_equal_dense_ones(solved):
    """1e-8 of the part's own sigmas, so that neither hides behind the other."""
    problem, _, found, (own, Y, P_zz) = solved
    E, at, worst = len(problem.epochs.time_ns), 0, {"own": 0.0, "common": 0.0, "with statics": 0.0}
    sigma_z = np.sqrt(np.diagonal(P_zz))
    for c in range(len(problem.chains)):
        b, q = problem.chain_size(c), found.columns[c]
        for k in range(E):
            rows = slice(at + k * b, at + (k + 1) * b)
            worst["own"] = max(
                worst["own"], _off(found.Z[c][k], own[rows, rows], np.sqrt(np.diagonal(own[rows, rows])))
            )
            ours = found.Y[c][k] @ found.P_zz[np.ix_(q, q)] @ found.Y[c][k].T
            common = Y[rows] @ P_zz @ Y[rows].T
            # Rates of a body hardly follow the statics: in their own sigma there would be rounding over rounding.
            sigma = np.maximum(np.sqrt(np.diagonal(common)), 1e-3 * np.sqrt(np.diagonal(own[rows, rows])))
            worst["common"] = max(worst["common"], _off(ours, common, sigma))
            cross = (-found.Y[c][k] @ found.P_zz[q] + Y[rows] @ P_zz) / (sigma[:, None] * sigma_z)
            worst["with statics"] = max(worst["with statics"], np.abs(cross).max())
        at += E * b
    print(worst, _off(found.P_zz, P_zz, sigma_z))
    assert max(worst.values()) < 1e-8
    assert _off(found.P_zz, P_zz, sigma_z) < 1e-8


def test_from_the_same_start_a_dense_least_squares_ends_in_the_same_place(solved):
    """Gauss-Newton by LAPACK on the whole Jacobian, halved while the cost rises, until it stands still."""
    problem, values, _, (_, _, P_zz) = solved
    other, cost = problem.first, np.inf
    for _ in range(30):
        r, J, _ = dense.jacobian(problem, other)
        before, cost = cost, 0.5 * r @ r
        if before - cost < 1e-14 * cost:
            break
        scale = np.linalg.norm(J, axis=0)
        step = -np.linalg.lstsq(J / scale, r, rcond=None)[0] / scale
        while 0.5 * np.sum(dense.jacobian(problem, _moved(problem, other, step))[0] ** 2) > cost * (
            1 + 1e-12
        ):
            step = 0.5 * step
        other = _moved(problem, other, step)
    r, J, n = dense.jacobian(problem, values)
    # What is left between the two, as a step, in sigmas.
    left = -np.linalg.lstsq(J, r, rcond=None)[0]
    print(f"cost {0.5 * r @ r:.9f}, dense {cost:.9f}; largest step left {np.abs(left[n:]).max():.1e} sigma")
    assert 0.5 * r @ r == pytest.approx(cost, rel=1e-8)
    sigma_z = np.sqrt(np.diagonal(P_zz))
    assert np.abs((values.z - other.z) / sigma_z).max() < 1e-3
    for ours, theirs in zip(values.pose, other.pose, strict=True):
        # The curve of an unchecked sensor is held during the steps, which the bucket follows by 1.7e-6 rad.
        assert np.abs(ours - theirs).max() < 3e-6


@pytest.mark.parametrize("frame", ["body cab", "body stick", "body bucket", fr.TOOL])
def test_both_parts_of_a_body_in_the_world_equal_dense_ones(solved, frame):
    """Of the cutting edge and all that carries it; its error by every unknown from differences of poses."""
    problem, values, found, (own, Y, P_zz) = solved
    track = body_track(problem, values, found, frame, frame)
    E, size, n = len(problem.epochs.time_ns), len(own) + len(P_zz), len(own)

    def pose(x):
        moved = _moved(problem, values, x)
        path = problem.tie.frames.path(fr.WORLD, frame)
        _, T = fr.along(path, lambda edge: moved.edge_pose(problem.statics, edge))
        return np.broadcast_to(T, (E, 4, 4))

    J = np.zeros((E, 6, size))
    for i in range(size):
        x = np.zeros(size)
        slope = []
        for h in (2e-3, 1e-3):
            x[i] = h
            slope.append((se3.local(pose(0 * x), pose(x)) - se3.local(pose(0 * x), pose(-x))) / (2 * h))
        J[:, :, i] = (4 * slope[1] - slope[0]) / 3  # Richardson: the rest is of fourth order
    M = J[:, :, n:] - J[:, :, :n] @ Y
    expected_own = J[:, :, :n] @ own @ np.swapaxes(J[:, :, :n], -1, -2)
    expected_common = M @ P_zz @ np.swapaxes(M, -1, -2)
    off = [
        _off(ours, expected, np.sqrt(np.einsum("nii->ni", expected)))
        for ours, expected in (
            (track.own, expected_own), (common_part(track, found.P_zz), expected_common)
        )
    ]  # fmt: skip
    print(f"{frame}: own off by {off[0]:.1e} of its sigmas, common by {off[1]:.1e}")
    assert max(off) < 1e-8
